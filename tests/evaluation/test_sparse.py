"""Values only where the surface may be: the same triangles as from the whole grid, for fields chosen to be missed."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
import trimesh

from sdfnet.errors import ConfigurationError, ReconstructionError
from sdfnet.evaluation.reconstruct import Grid, surface_from_values
from sdfnet.evaluation.sparse import EVERY_SECOND, EXACT, SparseValues, exact_values, predicted_between, reach_between, sparse_values
from sdfnet.geometry.distance import SurfaceDistance
from sdfnet.geometry.surface import Surface

Field = Callable[[np.ndarray], np.ndarray]  # (points, 3) to (points,), m


def ball(centre: tuple[float, float, float], radius: float) -> Field:
    return lambda points: np.linalg.norm(points - centre, axis=1) - radius


def cuboid(half_sides: tuple[float, float, float]) -> Field:
    def distance(points: np.ndarray) -> np.ndarray:
        beyond = np.abs(points - 0.01) - half_sides
        return np.linalg.norm(np.maximum(beyond, 0.0), axis=1) + np.minimum(beyond.max(axis=1), 0.0)

    return distance


def union(*fields: Field) -> Field:
    return lambda points: np.min([field(points) for field in fields], axis=0)


# In a box of side 2 with 40 points a side: cells of 0.051 m, coarser points 0.41, 0.21 and 0.1 m apart.
FIELDS = {
    "ball": ball((0.1, 0.05, -0.1), 0.6),
    "ball of two cells": ball((0.21, 0.33, -0.41), 0.06),
    "plate of two cells": cuboid((0.6, 0.7, 0.05)),
    "needle": cuboid((0.04, 0.04, 0.8)),
    "two balls that all but touch": union(ball((-0.31, 0.0, 0.0), 0.3), ball((0.36, 0.0, 0.0), 0.3)),
    "ball within a cell of the box": ball((0.0, 0.0, 0.38), 0.58),
    "two balls far apart": union(ball((-0.8, -0.8, -0.8), 0.09), ball((0.85, 0.85, 0.85), 0.07)),
}


def grid_of(resolution: int) -> Grid:
    return Grid(np.full(3, -1.0), np.array([1.0, 1.05, 0.99]), resolution)


def dense_values(field: Field, grid: Grid) -> torch.Tensor:
    return torch.from_numpy(field(grid.points().numpy()).astype(np.float32)).reshape(grid.shape)


def sparse(field: Field, grid: Grid, slopes: tuple[float, ...] = EXACT) -> SparseValues:
    return sparse_values(lambda indices: field(grid.points_at(indices).numpy()).astype(np.float32), grid, slopes)


def on_whole_grid(found: SparseValues, grid: Grid) -> np.ndarray:
    values = np.full(grid.shape, np.inf, np.float32)
    values[tuple(slice(first, first + count) for first, count in zip(found.start, found.values.shape, strict=True))] = found.values
    return values


def assert_same_surface(found: SparseValues, dense: torch.Tensor, grid: Grid) -> None:
    surface, expected = surface_from_values(torch.from_numpy(found.values), grid, found.start), surface_from_values(dense, grid)
    np.testing.assert_array_equal(surface.faces, expected.faces)
    np.testing.assert_array_equal(surface.vertices, expected.vertices)


@pytest.mark.parametrize("resolution", [40, 41, 42, 49])
@pytest.mark.parametrize("name", FIELDS)
def test_true_distances_give_the_triangles_of_the_whole_grid(name: str, resolution: int) -> None:
    grid = grid_of(resolution)
    dense, found = dense_values(FIELDS[name], grid), sparse(FIELDS[name], grid)
    assert np.array_equal(on_whole_grid(found, grid) < 0, dense.numpy() < 0)
    assert_same_surface(found, dense, grid)


@pytest.mark.parametrize("resolution", range(2, 26))
def test_grids_of_any_number_of_points_have_the_right_sides(resolution: int) -> None:
    grid = grid_of(resolution)
    for field in FIELDS.values():
        np.testing.assert_array_equal(on_whole_grid(sparse(field, grid), grid) < 0, dense_values(field, grid).numpy() < 0)


def test_no_cut_edge_is_left_out_and_its_ends_have_their_own_values() -> None:
    grid = grid_of(40)
    dense, found = dense_values(FIELDS["needle"], grid).numpy(), on_whole_grid(sparse(FIELDS["needle"], grid), grid)
    for axis in range(3):
        lower, upper = (np.moveaxis(dense, axis, 0)[places] for places in (slice(-1), slice(1, None)))
        is_cut = (lower < 0) != (upper < 0)
        assert is_cut.any()
        for ends, expected in ((slice(-1), lower), (slice(1, None), upper)):
            np.testing.assert_array_equal(np.moveaxis(found, axis, 0)[ends][is_cut], expected[is_cut])


def test_a_ball_of_barely_one_cell_is_found_wherever_it_lies() -> None:
    grid = grid_of(40)
    for centre in np.random.default_rng(0).uniform(-0.9, 0.9, (60, 3)):
        field = ball(tuple(centre), 0.046)  # half the diagonal of a cell is 0.045 m: it always holds a grid point
        assert (sparse(field, grid).values < 0).any()


def test_points_between_get_the_mean_of_their_nearest_and_the_others_keep_their_bits() -> None:
    grid, shape = Grid(np.zeros(3), np.array([6.0, 12.0, 18.0]), 7), (7, 6, 5)
    x, y, z = np.meshgrid(*(axis[:count] for axis, count in zip(grid.axes, shape, strict=True)), indexing="ij")
    linear = (0.3 * x - 0.7 * y + 1.1 * z + 0.1).astype(np.float32)
    predicted = predicted_between(linear[EVERY_SECOND], shape)
    np.testing.assert_array_equal(predicted[EVERY_SECOND], linear[EVERY_SECOND])
    np.testing.assert_allclose(predicted[:, :-1], linear[:, :-1], atol=1e-5)  # 40 metres at most, rounded to float32 three times
    np.testing.assert_allclose(predicted[:, -1], linear[:, -2], atol=1e-5)  # the last of an even number has one neighbour along the axis
    reach = reach_between(grid, shape)
    np.testing.assert_allclose([reach[0, 0, 0], reach[1, 0, 0], reach[2, 1, 0], reach[1, 5, 3]], [0.0, 1.0, 2.0, np.sqrt(14.0)], rtol=1e-6)


def test_a_small_part_of_the_grid_is_asked_for_and_no_point_twice_at_one_level() -> None:
    grid, asked = grid_of(100), []

    def ask(indices: np.ndarray) -> np.ndarray:
        asked.append(indices)
        return FIELDS["ball"](grid.points_at(indices).numpy()).astype(np.float32)

    found = sparse_values(ask, grid)
    # Points nearer than 1, 1.4 and 1.7 cells, as far as the neighbours they are predicted from are, 3 to 3 to 1, fill a shell 2.6 cells thick about
    # 4 pi 30^2 cells, 7/8 of it: 26,000 of 10^6. The coarser levels ask for a fourth and a sixteenth as many, and ends of cut edges come on top.
    assert found.asked < 0.042 * grid.resolution**3
    assert found.asked == len(np.unique(np.concatenate(asked)))
    assert found.asked == sum(len(indices) for indices in asked)


def test_a_steep_field_needs_its_slope() -> None:
    steep, grid = (lambda points: 3 * FIELDS["ball of two cells"](points)), grid_of(40)
    assert not (sparse(steep, grid).values < 0).any(), "three times steeper than a distance, the ball is not seen"
    assert_same_surface(sparse(steep, grid, (3.0, 3.0, 3.0)), dense_values(steep, grid), grid)


def test_a_surface_found_in_part_is_followed_until_it_closes() -> None:
    grid = grid_of(40)

    def steep_on_one_side(points: np.ndarray) -> np.ndarray:
        return FIELDS["ball"](points) * np.where(points[:, 0] > 0.1, 6.0, 1.0)

    assert_same_surface(sparse(steep_on_one_side, grid), dense_values(steep_on_one_side, grid), grid)


def test_a_surface_that_leaves_the_block_it_was_found_in_is_followed_through_the_grid() -> None:
    grid = grid_of(40)

    def ball_with_rod(points: np.ndarray) -> np.ndarray:
        rod = np.maximum(9.0 * (np.hypot(points[:, 0] - 0.077, points[:, 1] - 0.104) - 0.06), np.abs(points[:, 2]) - 0.95)
        return np.minimum(ball((0.0, 0.0, 0.0), 0.5)(points), rod)  # between the points of every coarser level, too steep to be seen

    found = sparse(ball_with_rod, grid)
    assert found.values.shape == grid.shape
    assert_same_surface(found, dense_values(ball_with_rod, grid), grid)


def test_a_piece_that_nothing_but_one_of_the_coarsest_points_saw_is_found_whole() -> None:
    grid = grid_of(40)

    def jumps(points: np.ndarray) -> np.ndarray:
        return np.where(ball((-0.59, -0.58, -0.59), 0.12)(points) < 0, -5.0, FIELDS["ball of two cells"](points))

    assert_same_surface(sparse(jumps, grid), dense_values(jumps, grid), grid)


def test_a_small_surface_gives_a_small_block_about_it() -> None:
    grid = grid_of(40)
    found = sparse(FIELDS["ball of two cells"], grid)
    assert max(found.values.shape) <= 2 * (1 + 8 + 3)  # the ball, and on either side what the points 8 cells apart cannot tell from it, rounded to every second
    assert (on_whole_grid(found, grid) < 0).any()


def test_a_field_of_one_sign_and_one_cut_by_the_box_are_refused_as_on_the_whole_grid() -> None:
    grid = grid_of(40)
    for field in (lambda points: FIELDS["ball"](points) + 5.0, lambda points: -FIELDS["ball"](points), ball((0.7, 0.0, -0.2), 0.5)):
        dense, found = dense_values(field, grid), sparse(field, grid)
        with pytest.raises(ReconstructionError) as expected:
            surface_from_values(dense, grid)
        with pytest.raises(ReconstructionError) as refused:
            surface_from_values(torch.from_numpy(found.values), grid, found.start)
        ranges_differ = "both sides" in str(expected.value)  # the lowest and highest value are bounds
        assert str(refused.value).split(", found")[0] == str(expected.value).split(", found")[0]
        assert ranges_differ or str(refused.value) == str(expected.value)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_values_that_are_not_finite_are_kept_and_refused(bad: float) -> None:
    grid = grid_of(40)

    def broken(points: np.ndarray) -> np.ndarray:
        return np.where((points < -0.9).all(axis=1), bad, FIELDS["ball of two cells"](points))  # far from the ball, about one of the coarsest points

    found = sparse(broken, grid)
    with pytest.raises(ReconstructionError, match="every value must be finite"):
        surface_from_values(torch.from_numpy(found.values), grid, found.start)


@pytest.mark.parametrize("slopes", [(1.0, 1.0), (1.0, 0.0, 1.0), (1.0, float("nan"), 1.0), (1.0, float("inf"), 1.0)])
def test_slopes_that_bound_nothing_are_refused(slopes: tuple[float, ...]) -> None:
    with pytest.raises(ConfigurationError, match=r"a positive, finite slope for each of the levels with points every \(4, 2, 1\) cells"):
        sparse(FIELDS["ball"], grid_of(10), slopes)


@pytest.mark.parametrize("resolution", [24, 37])
def test_exact_values_give_the_triangles_of_a_query_at_every_point(resolution: int) -> None:
    icosphere = trimesh.creation.icosphere(subdivisions=3, radius=0.3)
    vertices = np.vstack([icosphere.vertices + [0.0, 0.1, 0.0], icosphere.vertices + [0.65, -0.3, 0.2]])
    distance = SurfaceDistance(Surface(vertices, np.vstack([icosphere.faces, icosphere.faces + len(icosphere.vertices)])))
    grid = Grid(np.array([-0.5, -0.7, -0.5]), np.array([1.1, 0.6, 0.8]), resolution)
    found, dense = exact_values(distance, grid), distance.signed_distance(grid.points()).reshape(grid.shape)
    assert np.array_equal(on_whole_grid(found, grid) < 0, dense.numpy() < 0)
    assert_same_surface(found, dense, grid)
