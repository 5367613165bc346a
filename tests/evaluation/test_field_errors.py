"""Errors of fields and of the solids that they bound, against values worked out by hand."""

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from sdfnet.errors import ReconstructionError
from sdfnet.evaluation.field_errors import eikonal_error, field_errors, volume_errors


@pytest.mark.parametrize("predicted_radius", [0.8, 1.0, 1.1])
def test_concentric_balls_overlap_by_the_ratio_of_volumes(predicted_radius: float) -> None:
    edge = np.full(3, 1.1)
    errors = volume_errors(lambda points: points.norm(dim=1) < predicted_radius, lambda points: points.norm(dim=1) < 1.0, -edge, edge, samples=200_000)
    ratio = predicted_radius**3
    # Of 200,000 points 39 % are inside: the share of them in the smaller ball is known to 0.2 %.
    assert errors.intersection_over_union == pytest.approx(min(ratio, 1 / ratio), abs=0.006)
    assert errors.volume_error_percent == pytest.approx(100 * abs(ratio - 1), abs=0.6)


def test_balls_apart_share_nothing() -> None:
    errors = volume_errors(lambda points: points[:, 0] > 0.5, lambda points: points[:, 0] < -0.5, -np.ones(3), np.ones(3), samples=20_000)
    assert errors.intersection_over_union == 0.0
    assert errors.volume_error_percent < 5  # equal volumes; five standard deviations of 5,000 counts


def test_true_solid_outside_the_box_is_refused() -> None:
    with pytest.raises(ReconstructionError, match="found none of 100 points inside"):
        volume_errors(lambda points: points[:, 0] > 0, lambda points: points[:, 0] > 9, -np.ones(3), np.ones(3), samples=100)


def test_field_errors_are_taken_over_bands_of_the_true_distance() -> None:
    true = torch.tensor([0.005, -0.005, 0.03, -0.3])  # D = 1: two within 1 %, three within 5 %
    predicted = true + torch.tensor([0.001, -0.003, 0.002, 0.006])
    errors = field_errors(predicted, true, diagonal=1.0)
    assert (errors.mae_within_1_percent_mm, errors.max_within_1_percent_mm) == pytest.approx((2.0, 3.0), rel=1e-5)
    assert errors.rmse_within_1_percent_mm == pytest.approx(math.sqrt(5), rel=1e-5)
    assert (errors.mae_within_5_percent_mm, errors.max_within_5_percent_mm) == pytest.approx((2.0, 3.0), rel=1e-5)
    assert errors.rmse_within_5_percent_mm == pytest.approx(math.sqrt(14 / 3), rel=1e-5)
    assert (errors.mae_mm, errors.rmse_mm, errors.max_mm) == pytest.approx((3.0, math.sqrt(12.5), 6.0), rel=1e-4)


def test_points_on_the_wrong_side_are_counted() -> None:
    errors = field_errors(torch.tensor([0.1, -0.1, 0.1, -0.1]), torch.tensor([0.2, -0.2, -0.2, -0.2]), diagonal=1.0)
    assert errors.sign_error_percent == 25.0
    assert math.isnan(errors.mae_within_1_percent_mm)


def test_true_distance_has_no_eikonal_error() -> None:
    points = torch.from_numpy(np.random.default_rng(0).uniform(1, 2, (500, 3)).astype(np.float32))
    errors = eikonal_error(lambda query: query.norm(dim=1) - 1.0, points)
    assert errors.eikonal_p99 < 1e-6


def test_eikonal_error_is_the_departure_of_the_slope_from_one_also_while_gradients_are_off() -> None:
    points = torch.linspace(-1, 1, 300).reshape(-1, 3)

    def slope(query: Tensor) -> Tensor:
        return torch.where(points[:, 0] > 0.99, 5.0, 0.75) * query[:, 2]

    with torch.inference_mode():
        errors = eikonal_error(slope, points)
    assert errors.eikonal_mean == pytest.approx(0.25)
    assert errors.eikonal_p99 == pytest.approx(0.25)
