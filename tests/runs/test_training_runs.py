"""A whole small run learns."""

from dataclasses import replace

from sdfnet.training.cycle import Phase
from sdfnet.training.settings import TrainingSettings
from tests.runs.resumable_run import SMALL, Recipe, Run


def test_training_brings_the_error_down(run: Run) -> None:
    settings = TrainingSettings(12, (Phase("both", 1),), power=1, focus=0.01, latent_weight=0.0)
    batch = replace(SMALL.batch, points_per_step=400, steps_per_epoch=25)
    model = replace(SMALL.model, width=24, frequencies=12, frequency_scale=0.5)
    readings = run(Recipe(model, batch, settings, replace(SMALL.optimizer, decoder_rate=0.01)), epochs=12).readings
    assert readings[11]["loss/validation_mean"] < 0.2 * readings[0]["loss/validation_mean"]
