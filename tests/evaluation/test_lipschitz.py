"""The slope that a search needs: measured no smaller than what loses nothing, and not spoilt by what is far away."""

import numpy as np
import pytest

from sdfnet.evaluation.lipschitz import LEAST, SAFETY, cut_cells, measured_slopes
from sdfnet.evaluation.reconstruct import Grid
from sdfnet.evaluation.sparse import sparse_values
from tests.evaluation.test_sparse import on_whole_grid

GRID = Grid(np.full(3, -1.0), np.full(3, 1.0), 41)
RADII = np.linalg.norm(np.stack(np.meshgrid(*GRID.axes, indexing="ij")) - 0.013, axis=0)


def ball_values(radius: float, slope: float) -> np.ndarray:
    return (slope * (RADII - radius)).astype(np.float32)


def test_slope_of_a_steep_distance_is_its_factor() -> None:
    found = np.array(measured_slopes(ball_values(0.5, 2.5)[None], GRID)[:2]) / SAFETY
    # The surface meets a block at its very corner only by chance: in small blocks it can stay a fifth of the half diagonal away from there.
    assert (found <= 2.5 * (1 + 1e-5)).all()
    assert (found > 2.5 * 0.8).all()


def test_slope_between_points_is_that_of_the_crease_they_do_not_see() -> None:
    spacing, half = GRID.spacing[0], 0.1 * GRID.spacing[0]
    for middle in (20, 21):  # whether or not the plate lies on a point that the search would predict
        plate = 2.5 * (np.abs(np.moveaxis(np.stack(np.meshgrid(*GRID.axes, indexing="ij")), 0, -1)[..., 0] - GRID.axes[0][middle]) - half)
        found = measured_slopes(plate.astype(np.float32)[None], GRID)[2] / SAFETY
        # Both neighbours lie spacing - half outside, one spacing away, and the point half inside.
        assert found == pytest.approx(2.5 * (spacing - half) / spacing, rel=1e-5)


def test_a_smooth_surface_has_the_least_slope_between_points() -> None:
    # On a ball of 10 cells the mean of two neighbours is at most 1/20 of a cell off.
    assert measured_slopes(ball_values(0.5, 2.5)[None], GRID)[2] == SAFETY * LEAST[2]


def test_a_thin_rod_on_a_ball_needs_no_slope_because_the_search_follows_it() -> None:
    x, y, z = np.stack(np.meshgrid(*GRID.axes, indexing="ij"))
    rod = np.maximum(np.hypot(x - GRID.axes[0][21], y - GRID.axes[1][21]) - 0.4 * GRID.spacing[0], np.abs(z) - 0.8)
    values, alone = (np.minimum(ball, 3 * rod).astype(np.float32) for ball in (ball_values(0.5, 1.0), np.full_like(RADII, np.inf)))
    slopes = measured_slopes(values[None], GRID)
    assert slopes[2] == SAFETY * LEAST[2]
    assert measured_slopes(alone[None], GRID)[2] > 2
    found = sparse_values(lambda indices: values.reshape(-1)[indices], GRID, slopes)
    np.testing.assert_array_equal(on_whole_grid(found, GRID) < 0, values < 0)


def test_the_steepest_of_all_frames_counts_and_never_less_than_a_distance() -> None:
    frames = np.stack([ball_values(0.5, 0.3), ball_values(0.6, 1.7), ball_values(0.4, 1.2)])
    assert measured_slopes(frames, GRID) == measured_slopes(frames[1:2], GRID)
    assert measured_slopes(frames[:1], GRID) == tuple(SAFETY * least for least in LEAST)


def test_what_is_steep_far_from_the_surface_does_not_count() -> None:
    values = ball_values(0.3, 1.0)
    far = np.where(RADII > 0.8, 20 * values, values)
    assert measured_slopes(far[None], GRID) == measured_slopes(values[None], GRID)


def test_a_field_without_a_surface_has_the_slope_of_a_distance() -> None:
    assert measured_slopes(ball_values(0.3, 1.0)[None] + 9.0, GRID) == tuple(SAFETY * least for least in LEAST)


@pytest.mark.parametrize("seed", range(5))
def test_measured_slopes_lose_no_cell_of_a_rough_field(seed: int) -> None:
    waves = np.random.default_rng(seed).normal(0.0, 5.0, (3, 6))
    phases = np.tensordot(np.stack(np.meshgrid(*GRID.axes, indexing="ij")), waves, axes=(0, 0))
    values = (RADII - 0.5 + 0.06 * np.sin(phases).sum(axis=-1)).astype(np.float32)
    slopes = measured_slopes(values[None], GRID)
    found = sparse_values(lambda indices: values.reshape(-1)[indices], GRID, slopes)
    np.testing.assert_array_equal(on_whole_grid(found, GRID) < 0, values < 0)


def test_cut_cells_are_those_with_corners_on_both_sides() -> None:
    is_inside = np.random.default_rng(0).random((5, 6, 7)) < 0.2
    expected = np.zeros((5, 6, 7), bool)
    for x, y, z in np.ndindex(4, 5, 6):
        corners = is_inside[x : x + 2, y : y + 2, z : z + 2]
        expected[x, y, z] = corners.any() and not corners.all()
    np.testing.assert_array_equal(cut_cells(is_inside), expected)
