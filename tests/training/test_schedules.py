"""Learning rates over time."""

import pytest
import torch
from torch.optim import SGD

from sdfnet.errors import ConfigurationError, TrainingError
from sdfnet.training.schedules import PAPER_PLATEAUS, Plateau, decay, take_reading
from sdfnet.training.settings import OptimizerSettings, TrainingSettings

BATCH, VALIDATION = PAPER_PLATEAUS


def optimizer(rate: float = 1.0) -> SGD:
    return SGD([torch.nn.Parameter(torch.zeros(1))], lr=rate)


def test_the_first_plateau_is_active_in_the_papers_epochs_3_to_19() -> None:
    # the paper counts epochs from 1, the code from 0
    assert [epoch + 1 for epoch in range(600) if BATCH.is_active(epoch)] == list(range(3, 20))
    assert BATCH.watches == "batch"


def test_the_second_plateau_is_active_from_the_papers_epoch_20_on() -> None:
    assert [epoch + 1 for epoch in range(592) if VALIDATION.is_active(epoch)] == list(range(20, 593))
    assert VALIDATION.watches == "validation"


@pytest.mark.parametrize(("plateau", "patience", "factor"), [(BATCH, 30, 0.92), (VALIDATION, 2, 0.75)], ids=["batch", "validation"])
def test_the_rate_falls_by_the_factor_after_patience_readings_that_are_no_better(plateau: Plateau, patience: int, factor: float) -> None:
    adjusted = optimizer()
    scheduler = plateau.scheduler(adjusted)
    take_reading(scheduler, 1.0, "loss")
    for _ in range(patience):
        take_reading(scheduler, 1.0, "loss")
    assert adjusted.param_groups[0]["lr"] == 1.0
    take_reading(scheduler, 1.0, "loss")
    assert adjusted.param_groups[0]["lr"] == pytest.approx(factor, rel=1e-12)


def test_a_better_reading_starts_the_patience_anew() -> None:
    adjusted = optimizer()
    scheduler = VALIDATION.scheduler(adjusted)
    for value in (1.0, 1.0, 1.0, 0.5, 0.5, 0.5):
        take_reading(scheduler, value, "loss")
    assert adjusted.param_groups[0]["lr"] == 1.0


@pytest.mark.parametrize("value", [float("nan"), float("inf"), float("-inf")])
def test_a_loss_that_is_not_finite_stops_instead_of_cutting_the_rate(value: float) -> None:
    adjusted = optimizer()
    scheduler = Plateau(1, None, "batch", 0, 0.5).scheduler(adjusted)
    take_reading(scheduler, 1.0, "batch loss of epoch 7")
    with pytest.raises(TrainingError, match=f"the batch loss of epoch 7 must be finite, found {value}; lower the learning rates"):
        take_reading(scheduler, value, "batch loss of epoch 7")
    assert adjusted.param_groups[0]["lr"] == 1.0


@pytest.mark.parametrize(("kind", "at_a_quarter"), [("cosine", 0.5 * (1 + 0.5**0.5)), ("linear", 0.75)])
def test_a_decay_rises_over_the_warmup_and_falls_to_zero(kind: str, at_a_quarter: float) -> None:
    assert [decay(kind, progress, 0.2) for progress in (0.0, 0.1, 0.2)] == [0.0, 0.5, 1.0]
    assert decay(kind, 0.4, 0.2) == pytest.approx(at_a_quarter, abs=1e-12)
    assert decay(kind, 0.6, 0.2) == pytest.approx(0.5, abs=1e-12)
    assert decay(kind, 1.0, 0.2) == pytest.approx(0.0, abs=1e-12)
    falling = [decay(kind, 0.2 + 0.008 * step, 0.2) for step in range(101)]
    assert falling == sorted(falling, reverse=True)


@pytest.mark.parametrize("kind", ["cosine", "linear"])
def test_without_warmup_a_decay_starts_at_one_and_stays_at_zero_past_the_end(kind: str) -> None:
    assert decay(kind, 0.0, 0.0) == 1.0
    assert decay(kind, 1.5, 0.0) == pytest.approx(0.0, abs=1e-12)


def test_the_default_optimizer_is_the_papers() -> None:
    settings = OptimizerSettings()
    assert (settings.encoder_rate, settings.decoder_rate, settings.schedule, settings.plateaus) == (0.0075, 0.005, "plateau", PAPER_PLATEAUS)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"name": "sgd"}, "optimizer.name must be one of adam, soap; found 'sgd'"),
        ({"schedule": "step"}, "optimizer.schedule must be one of plateau, linear, cosine; found 'step'"),
        ({"decoder_rate": 0.0}, "optimizer.decoder_rate must be positive and finite, found 0.0"),
        ({"encoder_rate": float("nan")}, "optimizer.encoder_rate must be positive and finite, found nan"),
        ({"warmup": 1.0}, r"optimizer.warmup must lie in \[0, 1\), found 1.0"),
    ],
)
def test_optimizer_settings_that_cannot_be_are_refused_by_name(wrong: dict[str, str | float], message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        OptimizerSettings(**wrong)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"power": 3}, "training.power must be 1 or 2, found 3"),
        ({"focus": 0.0}, "training.focus must be positive, found 0.0"),
        ({"epochs": 0}, "training.epochs must be at least 1, found 0"),
        ({"validate_every": 0}, "training.validate_every must be at least 1, found 0"),
    ],
)
def test_training_settings_that_cannot_be_are_refused_by_name(wrong: dict[str, int | float], message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        TrainingSettings(**wrong)  # type: ignore[arg-type]


def test_a_plateau_that_cannot_be_is_refused() -> None:
    with pytest.raises(ConfigurationError, match="watches batch or validation, found 'epoch'"):
        Plateau(1, None, "epoch", 1, 0.5)
    with pytest.raises(ConfigurationError, match=r"a factor in \(0, 1\), found 1 and 1.5"):
        Plateau(1, None, "batch", 1, 1.5)
