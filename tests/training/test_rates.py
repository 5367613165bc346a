"""Optimisers and rates as a run has them: who has which, and when they change."""

from dataclasses import replace

import pytest

from sdfnet.training import module as module_file
from sdfnet.training.module import SdfTraining
from sdfnet.training.schedules import Plateau, decay
from sdfnet.training.settings import OptimizerSettings, TrainingSettings
from tests.training.short_run import BOTH, FRAMES, PAIRS, SHARED, SOAP, Before, Start


def test_the_papers_two_plateaus_on_two_networks_are_four_schedulers(start: Start) -> None:
    run = start(PAIRS, TrainingSettings(epochs=1, cycle=BOTH), OptimizerSettings()).fit()
    schedulers = [configured.scheduler for configured in run.trainer.lr_scheduler_configs]
    assert len({id(scheduler) for scheduler in schedulers}) == 4
    encoder, decoder = run.trainer.optimizers
    assert [scheduler.optimizer for scheduler in schedulers] == [encoder, decoder, encoder, decoder]
    assert [(scheduler.patience, scheduler.factor) for scheduler in schedulers] == [(30, 0.92)] * 2 + [(2, 0.75)] * 2  # type: ignore[attr-defined]
    assert [group["lr"] for optimizer in (encoder, decoder) for group in optimizer.param_groups] == [0.0075, 0.005]


def test_each_network_has_an_optimizer_of_its_own(start: Start) -> None:
    run = start(SHARED, TrainingSettings(epochs=1, cycle=BOTH), SOAP).fit()
    for optimizer, network in zip(run.trainer.optimizers, (run.module.networks.encoder, run.module.networks.decoder), strict=True):
        assert [id(weights) for group in optimizer.param_groups for weights in group["params"]] == [id(weights) for weights in network.parameters()]


def test_plateaus_listen_in_their_epochs_only_and_each_to_its_own_loss(start: Start, monkeypatch: pytest.MonkeyPatch) -> None:
    heard: list[str] = []
    monkeypatch.setattr(module_file, "take_reading", lambda scheduler, value, what: heard.append(f"{scheduler.patience} {what}"))
    plateaus = (Plateau(2, 3, "batch", 30, 0.92), Plateau(4, None, "validation", 2, 0.75))
    start(PAIRS, TrainingSettings(epochs=5, cycle=BOTH), OptimizerSettings(plateaus=plateaus), num_sanity_val_steps=1).fit()
    by_batch = [f"30 batch loss of epoch {epoch}" for epoch in (1, 2) for _ in range(2 * FRAMES)]  # paper epochs 2 and 3; two networks
    assert heard == by_batch + [f"2 validation loss of epoch {epoch}" for epoch in (3, 4) for _ in range(2)]


def test_a_plateau_of_zero_patience_cuts_both_rates(start: Start) -> None:
    plateaus = (Plateau(1, None, "batch", 0, 0.5),)
    # a rate of 1e-12 moves no weight in float32: the pairs of the second epoch repeat those of the first backwards, none is better than the best
    settings = OptimizerSettings(encoder_rate=1e-12, decoder_rate=1e-12, plateaus=plateaus)
    run = start(PAIRS, TrainingSettings(epochs=2, cycle=BOTH, latent_weight=0.0), settings).fit()
    first, second = (run.readings.of_epoch[epoch] for epoch in (0, 1))
    assert second["rate/encoder"] == second["rate/decoder"] == pytest.approx(first["rate/encoder"] * 0.5**FRAMES, rel=1e-9)


def test_a_run_without_plateaus_keeps_its_rates(start: Start) -> None:
    run = start(PAIRS, TrainingSettings(epochs=2, cycle=BOTH), OptimizerSettings(plateaus=())).fit()
    assert [(reading["rate/encoder"], reading["rate/decoder"]) for reading in run.readings.of_epoch.values()] == [(0.0075, 0.005)] * 2


@pytest.mark.parametrize("schedule", ["linear", "cosine"])
def test_decaying_rates_follow_epoch_and_step(start: Start, schedule: str) -> None:
    rates: dict[tuple[int, int], list[float]] = {}

    def note(module: SdfTraining, epoch: int, step: int) -> None:
        if step > 0:  # what the step before was taken with
            rates[epoch, step - 1] = [optimizer.param_groups[0]["lr"] for optimizer in module.trainer.optimizers]

    settings = replace(SOAP, schedule=schedule)
    start(SHARED, TrainingSettings(epochs=3, cycle=BOTH), settings, callbacks=[Before(note)]).fit()
    assert len(rates) == 9
    for (epoch, step), found in rates.items():
        factor = decay(schedule, (4 * epoch + step) / 12, 0.1)
        assert found == pytest.approx([0.002 * factor, 0.003 * factor], rel=1e-12)
