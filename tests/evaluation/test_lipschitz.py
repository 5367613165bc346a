"""The slope that a search needs: measured no smaller than what loses nothing, and not spoilt by what is far away."""

import numpy as np
import pytest

from sdfnet.evaluation.lipschitz import LEAST, SAFETY, measured_slopes
from sdfnet.evaluation.reconstruct import Grid
from sdfnet.evaluation.sparse import sparse_values
from tests.evaluation.test_sparse import ball, grid_of, on_whole_grid, sparse

GRID = Grid(np.full(3, -1.0), np.full(3, 1.0), 41)
RADII = np.linalg.norm(np.stack(np.meshgrid(*GRID.axes, indexing="ij")) - 0.013, axis=0)
FROM_MIDDLE = np.linalg.norm(np.stack(np.meshgrid(*GRID.axes, indexing="ij")), axis=0)  # of the grid, a point of each of its levels
LEAST_SLOPES = tuple(SAFETY * least for least in LEAST)


def ball_values(radius: float, slope: float) -> np.ndarray:
    return (slope * (RADII - radius)).astype(np.float32)


def small_ball(slope: float) -> np.ndarray:
    """Of a cell and a half, about the grid's middle: no coarser level has a point in it unless it has the middle."""
    return (slope * (FROM_MIDDLE - 1.5 * GRID.spacing[0])).astype(np.float32)


def test_slopes_of_a_ball_between_the_points_of_every_level() -> None:
    # The eight points about its middle are 4, 2 and 1 diagonals of a cell away from there. Between the last are others inside, with two points
    # a cell from them: a diagonal less a cell and a half outside.
    diagonal = np.sqrt(3.0)
    expected = 2.5 * np.array([1 - 1.5 / (4 * diagonal), 1 - 1.5 / (2 * diagonal), diagonal - 1.5])
    np.testing.assert_allclose(np.array(measured_slopes(small_ball(2.5)[None], GRID)) / SAFETY, expected, rtol=1e-5)


def test_slope_between_points_is_that_of_the_crease_they_do_not_see() -> None:
    spacing, half = GRID.spacing[0], 0.1 * GRID.spacing[0]
    for middle in (20, 21):  # whether or not the plate lies on a point that the search would predict
        plate = 2.5 * (np.abs(np.moveaxis(np.stack(np.meshgrid(*GRID.axes, indexing="ij")), 0, -1)[..., 0] - GRID.axes[0][middle]) - half)
        found = measured_slopes(plate.astype(np.float32)[None], GRID)[2] / SAFETY
        # Both neighbours lie spacing - half outside, one spacing away, and the point half inside.
        assert found == pytest.approx(2.5 * (spacing - half) / spacing, rel=1e-5)


def test_a_surface_in_one_piece_has_the_least_slopes_however_steep_because_the_search_follows_it() -> None:
    assert measured_slopes(ball_values(0.5, 2.5)[None], GRID) == LEAST_SLOPES


def test_a_thin_rod_on_a_ball_needs_no_slope_because_the_search_follows_it() -> None:
    x, y, z = np.stack(np.meshgrid(*GRID.axes, indexing="ij"))
    rod = np.maximum(np.hypot(x - GRID.axes[0][21], y - GRID.axes[1][21]) - 0.4 * GRID.spacing[0], np.abs(z) - 0.8)
    values, alone = (np.minimum(ball, 3 * rod).astype(np.float32) for ball in (ball_values(0.5, 1.0), np.full_like(RADII, np.inf)))
    slopes = measured_slopes(values[None], GRID)
    assert slopes[2] == SAFETY * LEAST[2]
    assert measured_slopes(alone[None], GRID)[2] > 2
    found = sparse_values(lambda indices: values.reshape(-1)[indices], GRID, slopes)
    np.testing.assert_array_equal(on_whole_grid(found, GRID) < 0, values < 0)


def test_the_steepest_of_all_frames_counts_and_never_less_than_the_least() -> None:
    frames = np.stack([small_ball(0.3), small_ball(1.7), small_ball(1.2)])
    assert measured_slopes(frames, GRID) == measured_slopes(frames[1:2], GRID)
    assert measured_slopes(frames[:1], GRID) == LEAST_SLOPES


def test_what_is_steep_far_from_the_surface_does_not_count() -> None:
    values = small_ball(1.7)
    far = np.where(FROM_MIDDLE > 0.4, 20 * values, values)
    assert measured_slopes(far[None], GRID) == measured_slopes(values[None], GRID)


def test_a_field_without_a_surface_has_the_least_slopes() -> None:
    assert measured_slopes(ball_values(0.3, 1.0)[None] + 9.0, GRID) == LEAST_SLOPES


def test_a_ball_of_three_cells_is_found_with_the_least_slopes_wherever_it_lies() -> None:
    grid = grid_of(40)
    for centre in np.random.default_rng(0).uniform(-0.85, 0.85, (60, 3)):
        assert (sparse(ball(tuple(centre), 0.077), grid, LEAST_SLOPES).values < 0).any()


@pytest.mark.parametrize("seed", range(5))
def test_measured_slopes_lose_no_cell_of_a_rough_field(seed: int) -> None:
    waves = np.random.default_rng(seed).normal(0.0, 5.0, (3, 6))
    phases = np.tensordot(np.stack(np.meshgrid(*GRID.axes, indexing="ij")), waves, axes=(0, 0))
    values = (RADII - 0.5 + 0.06 * np.sin(phases).sum(axis=-1)).astype(np.float32)
    slopes = measured_slopes(values[None], GRID)
    found = sparse_values(lambda indices: values.reshape(-1)[indices], GRID, slopes)
    np.testing.assert_array_equal(on_whole_grid(found, GRID) < 0, values < 0)
