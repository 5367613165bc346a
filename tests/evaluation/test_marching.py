"""Marching cubes: closed, outward, and reading only the values at edges along which the sign changes."""

import numpy as np
import pytest
import trimesh
from skimage.measure import marching_cubes as lewiner

from sdfnet.evaluation.marching import marching_cubes


def noise(seed: int) -> np.ndarray:
    values = np.ones((20, 21, 22), np.float32)
    values[1:-1, 1:-1, 1:-1] = np.random.default_rng(seed).normal(0.3, 1.0, (18, 19, 20))
    return values


@pytest.mark.parametrize("seed", range(4))
def test_noise_gives_a_closed_surface_that_faces_one_way(seed: int) -> None:
    mesh = trimesh.Trimesh(*marching_cubes(noise(seed)), process=False)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume > 0


def test_vertices_lie_on_edges_where_linear_interpolation_is_zero() -> None:
    values = noise(0)
    vertices, _ = marching_cubes(values)
    lower = np.floor(vertices).astype(int)
    share = vertices - lower
    assert ((share > 0).sum(axis=1) <= 1).all(), "each vertex is on an edge of the grid"
    ends = [values[tuple(corner.T)].astype(np.float64) for corner in (lower, lower + (share > 0))]
    between = (1 - share.max(axis=1)) * ends[0] + share.max(axis=1) * ends[1]
    np.testing.assert_allclose(between, 0.0, atol=2e-5)  # positions up to 22 in float32: 1e-6 of a cell, times values that change by up to 7


def test_only_signs_and_the_values_at_ends_of_cut_edges_matter() -> None:
    values = noise(1)
    is_end = np.zeros(values.shape, bool)
    for axis in range(3):
        inside, ends = np.moveaxis(values < 0, axis, 0), np.moveaxis(is_end, axis, 0)
        differs = inside[1:] != inside[:-1]
        ends[1:] |= differs
        ends[:-1] |= differs
    assert not is_end.all()
    changed = np.where(is_end, values, 7 * values)
    for found, expected in zip(marching_cubes(changed), marching_cubes(values), strict=True):
        np.testing.assert_array_equal(found, expected)


def test_surface_is_the_one_that_scikit_image_finds() -> None:
    x, y, z = np.meshgrid(*[np.linspace(-1.0013, 1.0, 41)] * 3, indexing="ij")
    values = np.minimum(np.hypot(np.hypot(x, y) - 0.6, z) - 0.2, np.sqrt(x**2 + y**2 + z**2) - 0.3).astype(np.float32)  # a torus about a ball
    ours, (corners, faces, _, _) = trimesh.Trimesh(*marching_cubes(values)), lewiner(values, 0.0, gradient_direction="descent")
    theirs = trimesh.Trimesh(corners, faces)
    assert ours.euler_number == theirs.euler_number == 2
    assert ours.volume == pytest.approx(theirs.volume, rel=1e-4)  # only how a face of the grid with four crossings is cut may differ
    # The vertices are the crossings of the same edges of the grid.
    assert np.allclose(np.unique(ours.vertices.round(3), axis=0), np.unique(theirs.vertices.round(3), axis=0), atol=2e-3)
