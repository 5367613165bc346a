"""Surfaces from values on a grid: where they lie, which way they face, and when they are refused."""

import numpy as np
import pytest
import torch
from torch import Tensor

from sdfnet.errors import ConfigurationError, ReconstructionError
from sdfnet.evaluation.marching import marching_cubes
from sdfnet.evaluation.reconstruct import Grid, surface_from_values, values_of_frames
from sdfnet.geometry.surface import Surface

RADIUS = 0.6
CENTRE = np.array([0.3, -0.2, 0.1])


def box_grid(resolution: int = 40) -> Grid:
    """A box about the sphere, not centred on it and of different spacing along each axis."""
    return Grid(np.array([-0.5, -1.2, -0.9]), np.array([1.2, 0.7, 0.9]), resolution)


def sphere_values(grid: Grid) -> Tensor:
    return (grid.points() - torch.from_numpy(CENTRE).float()).norm(dim=1).reshape(grid.shape) - RADIUS


def closed_volume(surface: Surface) -> float:
    mesh = surface.as_trimesh()
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    return float(mesh.volume)


def test_grid_points_fill_the_box_in_row_order() -> None:
    grid = box_grid(5)
    points = grid.points().reshape(5, 5, 5, 3)
    assert torch.equal(points[0, 0, 0], torch.from_numpy(grid.lower).float())
    assert torch.equal(points[-1, -1, -1], torch.from_numpy(grid.upper).float())
    np.testing.assert_allclose(points[1, 2, 3], [axis[index] for axis, index in zip(grid.axes, (1, 2, 3), strict=True)], rtol=1e-6)
    np.testing.assert_allclose(points[1, 1, 1] - points[0, 0, 0], grid.spacing, rtol=1e-6)


def test_points_at_indices_are_those_of_the_whole_grid() -> None:
    grid, indices = box_grid(7), np.array([342, 0, 50, 51])
    assert torch.equal(grid.points_at(indices), grid.points()[indices])


@pytest.mark.parametrize(
    ("lower", "upper", "resolution", "message"),
    [(0.0, 1.0, 1, "resolution of at least 2"), (1.0, 1.0, 10, "upper corner must lie above"), (np.nan, 1.0, 10, "upper corner must lie above")],
)
def test_grid_without_volume_is_refused(lower: float, upper: float, resolution: int, message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        Grid(np.full(3, lower), np.full(3, upper), resolution)


def test_sphere_comes_back_within_the_error_of_linear_interpolation() -> None:
    grid = box_grid()
    radii = np.linalg.norm(surface_from_values(sphere_values(grid), grid).vertices - CENTRE, axis=1)
    # On an edge of length h a function with second derivative 1/R departs from its chord by at most h^2 / 8R.
    assert np.abs(radii - RADIUS).max() <= grid.spacing.max() ** 2 / (8 * RADIUS) + 1e-6


def test_surface_is_closed_and_faces_outward() -> None:
    grid = box_grid()
    # Inscribed facets of size h lose about h^2 / R^2 of the volume: 0.6 % here.
    assert closed_volume(surface_from_values(sphere_values(grid), grid)) == pytest.approx(4 / 3 * np.pi * RADIUS**3, rel=0.01)


def test_marching_only_the_occupied_block_changes_no_triangle() -> None:
    grid = box_grid()
    values = sphere_values(grid)
    corners, triangles = marching_cubes(values.numpy())
    surface = surface_from_values(values, grid)
    np.testing.assert_array_equal(surface.faces, triangles)
    # The full run holds positions in float32 up to 40 grid steps: 4e-6 steps of rounding, and the level margin moves 1e-4 of a step.
    np.testing.assert_allclose(surface.vertices, grid.lower + corners * grid.spacing, atol=1.1e-4 * grid.spacing.max())


@pytest.mark.parametrize("seed", range(3))
def test_values_exactly_at_the_level_still_give_a_closed_surface_without_empty_triangles(seed: int) -> None:
    grid = Grid(np.zeros(3), np.ones(3), 14)
    values = torch.ones(grid.shape)
    values[1:-1, 1:-1, 1:-1] = torch.from_numpy(np.random.default_rng(seed).integers(-1, 2, (12, 12, 12)).astype(np.float32))
    surface = surface_from_values(values, grid)
    assert closed_volume(surface) > 0
    assert surface.as_trimesh().area_faces.min() > 0


def test_a_value_all_but_at_the_level_keeps_its_side() -> None:
    values = torch.ones(10, 10, 10)
    values[4, 5, 6] = -1e-12
    # An octahedron about that point, with corners at 1e-4 of the spacing: LEVEL_MARGIN over one metre of value.
    assert closed_volume(surface_from_values(values, Grid(np.zeros(3), np.full(3, 9.0), 10))) == pytest.approx(4 / 3 * 1e-12, rel=0.01)


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_field_of_one_sign_is_refused_with_its_range(sign: float) -> None:
    grid = box_grid(10)
    values = sign * torch.linspace(0.25, 2.0, 1000).reshape(grid.shape)
    with pytest.raises(ReconstructionError, match=r"found 0.25 to 2 m" if sign > 0 else r"found -2 to -0.25 m"):
        surface_from_values(values, grid)


def test_values_that_are_not_finite_are_counted_and_refused() -> None:
    grid = box_grid(10)
    values = sphere_values(grid)
    values[2, 3, 4], values[5, 5, 5] = torch.nan, torch.inf
    with pytest.raises(ReconstructionError, match="found 2 of 1000 that are not"):
        surface_from_values(values, grid)


@pytest.mark.parametrize(("axis", "side"), [(axis, side) for axis in range(3) for side in ("lower", "upper")])
def test_surface_cut_by_the_box_is_refused_naming_the_face(axis: int, side: str) -> None:
    lower, upper = CENTRE - 1.0, CENTRE + 1.0
    (lower if side == "lower" else upper)[axis] = CENTRE[axis]
    grid = Grid(lower, upper, 20)
    with pytest.raises(ReconstructionError, match=f"on the {side} {'xyz'[axis]} face"):
        surface_from_values(sphere_values(grid), grid)


def test_a_surface_cut_on_several_sides_names_them_all_with_their_points() -> None:
    values = torch.ones(10, 10, 10)
    values[5:, 4:6, :3] = -1.0  # leaves through the upper x face, 2 x 3 points, and through the lower z face, 5 x 2
    with pytest.raises(ReconstructionError, match="found points inside it on the box: 6 on the upper x face, 10 on the lower z face; enlarge the box"):
        surface_from_values(values, box_grid(10))


def test_values_that_touch_the_level_from_one_side_have_no_surface() -> None:
    grid = box_grid(10)
    touching = (sphere_values(grid) + RADIUS).clamp_min(0.5) - 0.5
    for values, message in ((touching, "found 0 to "), (-touching - 1e-6, "to -1e-06 m")):
        with pytest.raises(ReconstructionError, match=message):
            surface_from_values(values, grid)


def test_a_grid_of_nothing_but_nan_is_refused() -> None:
    with pytest.raises(ReconstructionError, match="found 1000 of 1000 that are not"):
        surface_from_values(torch.full((10, 10, 10), torch.nan), box_grid(10))


def test_values_of_another_grid_are_refused() -> None:
    with pytest.raises(ReconstructionError, match=r"grid's shape \(10, 10, 10\), found \(9, 9, 9\)"):
        surface_from_values(sphere_values(box_grid(9)), box_grid(10))


@pytest.mark.parametrize("rows", [1, 7, 300, 10_000])
def test_frames_of_a_field_are_its_values_in_calls_of_bounded_size(rows: int) -> None:
    grid, sizes = box_grid(9), []
    radii = torch.tensor([0.3, 0.4, 0.5])

    def field(points: Tensor) -> Tensor:
        sizes.append(3 * len(points))
        return points.norm(dim=1)[None] - radii[:, None]

    values = values_of_frames(field, grid, rows)
    assert torch.equal(values, field(grid.points()).reshape(3, 9, 9, 9))
    assert max(sizes[:-1]) <= max(rows, 3)
