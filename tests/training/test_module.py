"""How the LightningModule wires networks, schedules and losses, seen through short runs."""

import statistics

import pytest
import torch

from sdfnet.training.losses import alpha_latent, latent_loss
from sdfnet.training.module import SdfTraining
from sdfnet.training.settings import OptimizerSettings, TrainingSettings
from tests.training.short_run import BOTH, FRAMES, PAIRS, SHARED, SOAP, TURNS, Start


def test_the_loss_of_a_pair_is_equation_1(start: Start, first_weights: SdfTraining) -> None:
    losses: list[float] = []
    module = first_weights
    family = module._family
    for step in range(FRAMES):
        batch = family.step(0, step)
        latents = module.networks.latents(batch.shapes)
        with torch.no_grad():
            per_shape = (module.networks.decoder(latents, batch.points) - batch.distances).square().mean(dim=1)
        losses.append(float(per_shape.sum() / 2 + alpha_latent(0) * latent_loss(latents, batch.frames)))
    run = start(PAIRS, TrainingSettings(epochs=1, cycle=BOTH), OptimizerSettings(encoder_rate=1e-12, decoder_rate=1e-12)).fit()
    assert run.readings.of_epoch[0]["loss/train_mean"] == pytest.approx(statistics.fmean(losses), rel=1e-5)
    assert run.readings.of_epoch[0]["loss/train_max"] == pytest.approx(max(losses), rel=1e-5)


def test_the_validation_loss_is_the_mean_and_the_largest_over_the_shapes(start: Start, first_weights: SdfTraining) -> None:
    module = first_weights
    batch = module._family.validation
    with torch.no_grad():
        per_shape = (module.networks(batch.shapes, batch.points) - batch.distances).square().mean(dim=1)
    run = start(PAIRS, TrainingSettings(epochs=1, cycle=BOTH), OptimizerSettings(encoder_rate=1e-12, decoder_rate=1e-12)).fit()
    reading = run.readings.of_epoch[0]
    assert reading["loss/validation_mean"] == pytest.approx(float(per_shape.mean()), rel=1e-5)
    assert reading["loss/validation_max"] == pytest.approx(float(per_shape.max()), rel=1e-5)
    latents = module.networks.latents(module._family.shapes)
    assert reading["latent/cosine_first_to_last"] == pytest.approx(float(torch.cosine_similarity(latents[0], latents[-1], dim=0)), abs=1e-6)


def test_absolute_errors_are_measured_in_hundredths_of_the_diagonal_and_fade_with_distance(start: Start, first_weights: SdfTraining) -> None:
    module = first_weights
    batch, diagonal = module._family.validation, module._family.trajectory.mesh.diagonal
    with torch.no_grad():
        predicted, true = module.networks(batch.shapes, batch.points), batch.distances
    error = (predicted - true).abs() / (diagonal / 100)
    nearest = torch.where(predicted * true > 0, torch.minimum(predicted.abs(), true.abs()), 0)
    weighed = error / (1 + nearest / (0.02 * diagonal))
    training = TrainingSettings(epochs=1, cycle=BOTH, power=1, focus=0.02)
    run = start(PAIRS, training, OptimizerSettings(encoder_rate=1e-12, decoder_rate=1e-12)).fit()
    assert run.readings.of_epoch[0]["loss/validation_mean"] == pytest.approx(float(weighed.mean()), rel=1e-5)


def test_validation_comes_when_it_is_due(start: Start) -> None:
    run = start(SHARED, TrainingSettings(epochs=5, cycle=BOTH, validate_every=2), SOAP).fit()
    assert [epoch for epoch, reading in run.readings.of_epoch.items() if "loss/validation_mean" in reading] == [1, 3]
    assert sorted(run.readings.of_epoch) == [0, 1, 2, 3, 4]


def test_bf16_keeps_weights_and_losses_finite_and_float32(start: Start) -> None:
    run = start(PAIRS, TrainingSettings(epochs=8, cycle=TURNS), OptimizerSettings(), precision="bf16-mixed").fit()
    assert all(torch.isfinite(torch.tensor(list(reading.values()))).all() for reading in run.readings.of_epoch.values())
    for weights in run.module.networks.parameters():
        assert weights.dtype == torch.float32
        assert weights.isfinite().all()


def test_training_time_is_noted(start: Start) -> None:
    assert start(SHARED, TrainingSettings(epochs=1, cycle=BOTH), SOAP).fit().module.train_seconds > 0
