"""Trainings for several budgets: the seconds are kept to, more of them help, a run that diverges is a row."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from sdfnet.cost.distance_study import exact_distances
from sdfnet.cost.training_study import FULL, QUICK, Budget, near_error_mm, training_study
from sdfnet.cost.unseen_points import unseen_near_points
from sdfnet.data.datamodule import ShapeFamily
from sdfnet.models.networks import Networks
from sdfnet.training.module import SdfTraining
from tests.cost.conftest import MODEL, OPTIMIZER, TRAINING


@pytest.fixture(autouse=True)
def _quiet() -> None:
    torch.manual_seed(0)


def test_each_budget_is_a_point_and_the_users_own_setting_the_default(ball_family: ShapeFamily) -> None:
    budgets = (Budget(8, 0.3), Budget(None, 0.3), Budget(is_default=True))
    study, trained = training_study(ball_family, MODEL, TRAINING, OPTIMIZER, "32-true", budgets)
    assert [(point.method, point.setting, point.is_default) for point in study.points] == [
        ("width 8", "0.3 s", False),
        ("width 16", "0.3 s", False),
        ("width 16", "4 epochs", True),
    ]
    assert study.points[0].overrides == ("model.width=8", "model.frequencies=8", "training.seconds=0.3", "training.epochs=100000")
    assert [one.networks.decoder.parameter_count for one in trained] == [point.counts["decoder parameters"] for point in study.points]
    assert study.points[2].counts["steps"] == 4 * 40
    assert all(point.is_measured for point in study.points)


def test_training_ends_soon_after_its_seconds_and_its_rates_have_fallen_to_nothing(ball_family: ShapeFamily, monkeypatch: pytest.MonkeyPatch) -> None:
    rates: list[float] = []
    monkeypatch.setattr(SdfTraining, "on_train_epoch_end", lambda module: rates.extend(one.param_groups[0]["lr"] for one in module._both_optimizers()))
    study, _ = training_study(ball_family, MODEL, TRAINING, OPTIMIZER, "32-true", (Budget(None, 1.0),))
    (point,) = study.points
    assert point.seconds is not None
    assert 1.0 <= point.seconds.median < 3.0  # a step takes milliseconds; the machine may be busy
    for rate, first in zip(rates[-2:], (OPTIMIZER.encoder_rate, OPTIMIZER.decoder_rate), strict=True):
        assert rate < 0.2 * first  # the last step began within a fifth of the time from its end


def test_seconds_that_the_user_gave_are_said_beside_the_epochs(ball_family: ShapeFamily) -> None:
    study, _ = training_study(ball_family, MODEL, replace(TRAINING, seconds=0.05), OPTIMIZER, "32-true", (Budget(is_default=True), Budget(None, 0.1)))
    assert [point.setting for point in study.points] == ["4 epochs, 0.05 s at most", "0.1 s"]


def test_more_steps_lower_the_error(ball_family: ShapeFamily) -> None:
    study, _ = training_study(ball_family, MODEL, replace(TRAINING, epochs=1), OPTIMIZER, "32-true", (Budget(is_default=True),))
    longer, _ = training_study(ball_family, MODEL, replace(TRAINING, epochs=8), OPTIMIZER, "32-true", (Budget(is_default=True),))
    assert longer.points[0].pair[0] < 0.8 * study.points[0].pair[0]


def test_each_budget_validates_as_train_py_does(ball_family: ShapeFamily, monkeypatch: pytest.MonkeyPatch) -> None:
    """The paper's second plateau hears of nothing but the validation loss."""
    epochs: list[int] = []
    monkeypatch.setattr(SdfTraining, "on_validation_epoch_end", lambda module: epochs.append(module.current_epoch))
    training_study(ball_family, MODEL, replace(TRAINING, validate_every=2), OPTIMIZER, "32-true", (Budget(is_default=True),))
    assert epochs == [1, 3]


def test_the_users_own_training_is_whole_and_in_the_quick_study_ends_early_with_its_own_epochs(ball_family: ShapeFamily) -> None:
    assert Budget(is_default=True) in FULL
    (own,) = [budget for budget in QUICK if budget.is_default]
    study, _ = training_study(ball_family, MODEL, TRAINING, OPTIMIZER, "32-true", (own, replace(own, seconds=0.05)))
    assert [(point.setting, point.overrides, point.is_default) for point in study.points] == [
        ("4 epochs, 40 s at most", ("training.seconds=40",), True),
        ("4 epochs, 0.05 s at most", ("training.seconds=0.05",), True),
    ]
    assert study.points[0].counts["steps"] == 4 * 40


def test_run_that_diverges_is_a_failed_point(ball_family: ShapeFamily) -> None:
    study, trained = training_study(ball_family, MODEL, TRAINING, replace(OPTIMIZER, decoder_rate=1e30), "32-true", (Budget(is_default=True),))
    assert trained == []
    assert study.points[0].failure is not None
    assert "not finite" in study.points[0].failure


def test_error_is_in_millimetres_and_that_of_the_distance(ball_family: ShapeFamily) -> None:
    box, trajectory = ball_family.samples.box, ball_family.trajectory
    networks = Networks(MODEL, ball_family.shapes, torch.from_numpy(box.lower).float(), torch.from_numpy(box.upper).float())
    with torch.no_grad():
        for weights in networks.decoder.parameters():
            weights.zero_()
    points = unseen_near_points(trajectory, box)
    trained_at = ball_family.samples.near_points
    assert not np.isin(unseen_near_points(trajectory, box, len(trained_at)).numpy(), trained_at).all(axis=1).any()
    errors = []
    for frame in range(len(trajectory.times)):
        distances = np.abs(exact_distances(points.numpy(), trajectory.surface(frame)))
        errors.append(1e3 * distances[distances < 0.01 * trajectory.mesh.diagonal].mean())
    assert near_error_mm(networks, ball_family, frames=len(errors)) == pytest.approx(np.mean(errors), rel=1e-5)
