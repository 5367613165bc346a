"""The slope that a search needs: measured no smaller than what loses nothing, and not spoilt by what is far away."""

import numpy as np
import pytest

from sdfnet.evaluation.lipschitz import LEAST, RAISE, SAFETY, measured_slopes
from sdfnet.evaluation.reconstruct import Grid
from sdfnet.evaluation.sparse import SparseValues, sparse_values
from tests.evaluation.test_sparse import ball, grid_of, on_whole_grid, sparse

GRID = Grid(np.full(3, -1.0), np.full(3, 1.0), 41)
RADII = np.linalg.norm(np.stack(np.meshgrid(*GRID.axes, indexing="ij")) - 0.013, axis=0)
FROM_MIDDLE = np.linalg.norm(np.stack(np.meshgrid(*GRID.axes, indexing="ij")), axis=0)  # of the grid, a point of each of its levels
LEAST_SLOPES = tuple(SAFETY * least for least in LEAST)


def ball_values(radius: float, slope: float) -> np.ndarray:
    return (slope * (RADII - radius)).astype(np.float32)


def searched(values: np.ndarray, slopes: tuple[float, ...]) -> SparseValues:
    return sparse_values(lambda indices: values.reshape(-1)[indices], GRID, slopes)


def small_ball(slope: float, radius: float = 1.5, centre: tuple[float, float, float] = (20.0, 20.0, 20.0)) -> np.ndarray:
    """Radius and centre in cells."""
    place = [slice(None), *[None] * 3]
    away = np.linalg.norm(np.indices(GRID.shape) - np.array(centre)[tuple(place)], axis=0)
    return (slope * GRID.spacing[0] * (away - radius)).astype(np.float32)


@pytest.mark.parametrize("slope", [1.0, 1.5, 2.0, 3.0])
def test_measured_slopes_lose_no_small_steep_ball_wherever_it_lies(slope: float) -> None:
    rng = np.random.default_rng(int(10 * slope))
    for _ in range(12):
        values = small_ball(slope, rng.uniform(1.0, 3.0), tuple(rng.uniform(5, 35, 3)))
        slopes = measured_slopes(values[None], GRID)
        found = searched(values, slopes)
        np.testing.assert_array_equal(on_whole_grid(found, GRID) < 0, values < 0)


def test_a_ball_measured_at_one_place_is_found_at_others() -> None:
    slopes = measured_slopes(small_ball(2.0, centre=(24.0, 24.0, 24.0))[None], GRID)  # about one of the coarsest points
    for moved in range(8):
        values = small_ball(2.0, centre=(24.0 - moved,) * 3)
        np.testing.assert_array_equal(on_whole_grid(searched(values, slopes), GRID) < 0, values < 0)


def test_a_small_piece_far_from_a_large_one_counts() -> None:
    beside = np.minimum(small_ball(1.0, 8.0, (12.0, 12.0, 12.0)), small_ball(3.0, 1.5, (35.0, 35.0, 35.0)))
    slopes = measured_slopes(beside[None], GRID)
    np.testing.assert_array_equal(on_whole_grid(searched(beside, slopes), GRID) < 0, beside < 0)


def test_slopes_are_raised_together_and_no_further_than_the_field_rises() -> None:
    slopes = np.array(measured_slopes(small_ball(3.0)[None], GRID)) / SAFETY / LEAST
    assert slopes[0] == pytest.approx(slopes[1]) == pytest.approx(slopes[2])
    assert 1 < slopes[2] <= RAISE * 3.0 / LEAST[2]
    assert float(np.log(slopes[0]) / np.log(RAISE)) == pytest.approx(round(np.log(slopes[0]) / np.log(RAISE)))


def test_a_frame_that_is_not_finite_says_nothing() -> None:
    frames = np.stack([small_ball(1.7), small_ball(3.0)])
    frames[1, 0, 0, :] = np.inf
    frames[1, -1, -1, -1] = np.nan
    assert measured_slopes(frames, GRID) == measured_slopes(frames[:1], GRID)


def test_a_surface_in_one_piece_has_the_least_slopes_however_steep_because_the_search_follows_it() -> None:
    assert measured_slopes(ball_values(0.5, 2.5)[None], GRID) == LEAST_SLOPES


def test_a_thin_rod_on_a_ball_needs_no_slope_because_the_search_follows_it() -> None:
    x, y, z = np.stack(np.meshgrid(*GRID.axes, indexing="ij"))
    rod = np.maximum(np.hypot(x - GRID.axes[0][21], y - GRID.axes[1][21]) - 0.4 * GRID.spacing[0], np.abs(z) - 0.8)
    values, alone = (np.minimum(ball, 3 * rod).astype(np.float32) for ball in (ball_values(0.5, 1.0), np.full_like(RADII, np.inf)))
    slopes = measured_slopes(values[None], GRID)
    assert slopes == LEAST_SLOPES
    assert measured_slopes(alone[None], GRID)[2] > 2 * LEAST_SLOPES[2]
    found = searched(values, slopes)
    np.testing.assert_array_equal(on_whole_grid(found, GRID) < 0, values < 0)


def test_the_steepest_of_all_frames_counts_and_never_less_than_the_least() -> None:
    frames = np.stack([small_ball(0.3), small_ball(1.7), small_ball(1.2)])
    assert measured_slopes(frames, GRID) == measured_slopes(frames[1:2], GRID)
    assert measured_slopes(frames[:1], GRID) == LEAST_SLOPES


def test_what_is_steep_far_from_the_surface_does_not_count() -> None:
    values = small_ball(1.7)
    far = np.where(FROM_MIDDLE > 0.75, 20 * values, values)  # beyond the diagonal of 8 cells, 0.69 m
    assert measured_slopes(far[None], GRID) == measured_slopes(values[None], GRID)


def test_a_field_without_a_surface_has_the_least_slopes() -> None:
    assert measured_slopes(ball_values(0.3, 1.0)[None] + 9.0, GRID) == LEAST_SLOPES


def test_a_ball_of_three_cells_across_is_found_with_the_least_slopes_wherever_it_lies() -> None:
    grid = grid_of(40)
    for centre in np.random.default_rng(0).uniform(-0.85, 0.85, (60, 3)):
        assert (sparse(ball(tuple(centre), 0.077), grid, LEAST_SLOPES).values < 0).any()


@pytest.mark.parametrize("seed", range(5))
def test_measured_slopes_lose_no_cell_of_a_rough_field(seed: int) -> None:
    waves = np.random.default_rng(seed).normal(0.0, 5.0, (3, 6))
    phases = np.tensordot(np.stack(np.meshgrid(*GRID.axes, indexing="ij")), waves, axes=(0, 0))
    values = (RADII - 0.5 + 0.06 * np.sin(phases).sum(axis=-1)).astype(np.float32)
    slopes = measured_slopes(values[None], GRID)
    found = searched(values, slopes)
    np.testing.assert_array_equal(on_whole_grid(found, GRID) < 0, values < 0)
