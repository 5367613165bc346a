"""Winding numbers against libigl and against what geometry says; disagreements with a distance's sign are counted."""

import igl
import numpy as np
import pytest
import torch
import trimesh

from sdfnet.errors import GeometryError
from sdfnet.geometry import winding
from sdfnet.geometry.bunny import bunny_path, place
from sdfnet.geometry.distance import SurfaceDistance
from sdfnet.geometry.surface import Surface, load_surface
from sdfnet.geometry.winding import sign_disagreements, winding_number

# A point 1e-4 of an edge above a face sees it under an angle that float64 gives to 1e-12; thousands of faces add up to 1e-10.
ANGLE_ROUNDING = 1e-9


@pytest.fixture(scope="module")
def bunny() -> Surface:
    return place(load_surface(bunny_path()), "y", 0.1551, 0.007)


def _surface(mesh: trimesh.Trimesh) -> Surface:
    return Surface(np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64))


def _balls(*centres: float, flipped: bool = False) -> Surface:
    """Balls of radius 1 with their centres on the x axis, as one surface."""
    ball = _surface(trimesh.creation.icosphere(subdivisions=2))
    vertices = np.vstack([ball.vertices + [centre, 0.0, 0.0] for centre in centres])
    faces = np.vstack([ball.faces + k * len(ball.vertices) for k in range(len(centres))])
    return Surface(vertices, faces[:, ::-1].copy() if flipped else faces)


def test_on_and_about_the_bunny_it_is_libigls(bunny: Surface) -> None:
    generator = np.random.default_rng(0)
    corners = bunny.vertices[generator.permutation(bunny.faces)[:300]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    lower, upper = bunny.vertices.min(axis=0), bunny.vertices.max(axis=0)
    points = np.concatenate([generator.uniform(lower - 0.05, upper + 0.05, (300, 3)), corners.mean(axis=1) + 1e-6 * normals, corners[:, 0] - 1e-6 * normals])
    expected = igl.winding_number(bunny.vertices, bunny.faces, points)
    np.testing.assert_allclose(winding_number(points, bunny), expected, atol=ANGLE_ROUNDING, rtol=0)
    assert (expected > 0.5).sum() > 200
    assert (expected < 0.5).sum() > 200


def test_it_is_one_inside_nought_outside_and_counts_what_overlaps() -> None:
    points = np.array([[-0.9, 0.0, 0.0], [0.5, 0.0, 0.0], [1.9, 0.0, 0.0], [5.0, 0.0, 0.0], [0.5, 2.0, 0.0]])  # the second lies in both balls
    np.testing.assert_allclose(winding_number(points, _balls(0.0, 1.0)), [1, 2, 1, 0, 0], atol=ANGLE_ROUNDING, rtol=0)
    np.testing.assert_allclose(winding_number(points, _balls(0.0, 1.0, flipped=True)), [-1, -2, -1, 0, 0], atol=ANGLE_ROUNDING, rtol=0)


def test_a_cube_without_one_side_is_five_sixths_round_its_centre() -> None:
    cube = _surface(trimesh.creation.box((2.0, 2.0, 2.0)))
    is_top = (cube.vertices[cube.faces][:, :, 2] > 0).all(axis=1)
    open_cube = Surface(cube.vertices, cube.faces[~is_top])
    np.testing.assert_allclose(winding_number(np.zeros((1, 3)), open_cube), 5 / 6, atol=1e-12, rtol=0)


def test_size_and_place_of_the_solid_change_nothing(bunny: Surface) -> None:
    points = np.random.default_rng(1).uniform(bunny.vertices.min(axis=0), bunny.vertices.max(axis=0), (200, 3))
    expected = winding_number(points, bunny)
    for scale, shift in ((1e3, 0.0), (1e-3, 0.0), (1.0, 10.0)):
        found = winding_number(points * scale + shift, Surface(bunny.vertices * scale + shift, bunny.faces))
        np.testing.assert_allclose(found, expected, atol=ANGLE_ROUNDING, rtol=0)


def test_far_points_are_outside(bunny: Surface) -> None:
    points = np.random.default_rng(2).normal(size=(50, 3)) * 1e3 * bunny.diagonal
    np.testing.assert_allclose(winding_number(points, bunny), 0.0, atol=ANGLE_ROUNDING)


def test_blocks_of_any_size_give_the_same_numbers(bunny: Surface, monkeypatch: pytest.MonkeyPatch) -> None:
    points = np.random.default_rng(3).uniform(-0.1, 0.2, (101, 3))
    whole = winding_number(points, bunny)
    for pairs in (1, 7 * len(bunny.faces)):
        monkeypatch.setattr(winding, "PAIRS_PER_BLOCK", pairs)
        np.testing.assert_allclose(winding_number(points, bunny), whole, atol=ANGLE_ROUNDING, rtol=0)  # a sum's order depends on the block
    assert winding_number(points[:0], bunny).shape == (0,)


def test_points_and_distances_that_are_not_finite_are_refused_with_their_number() -> None:
    points, distances = np.zeros((3, 3)), np.zeros(3, dtype=np.float32)
    points[1, 2] = np.nan
    with pytest.raises(GeometryError, match="points must be finite, found 1 of 3 that are not; leave them out"):
        winding_number(points, _balls(0.0))
    distances[:2] = np.inf
    with pytest.raises(GeometryError, match="distances must be finite, found 2 of 3 that are not; measure them again"):
        sign_disagreements(np.zeros((3, 3)), distances, _balls(0.0))


def _measured(surface: Surface, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points as they are stored, in float32, and their distances by pseudo-normals."""
    stored = points.astype(np.float32)
    return stored, SurfaceDistance(surface).signed_distance(torch.from_numpy(stored)).numpy()


def test_signs_of_a_clean_surface_all_agree_even_of_points_on_it(bunny: Surface) -> None:
    generator = np.random.default_rng(4)
    about = bunny.vertices[generator.integers(0, len(bunny.vertices), 300)] + generator.choice([-1e-3, 0.0, 1e-3], (300, 1))
    points, distances = _measured(bunny, np.concatenate([about, bunny.vertices[:100]]))
    assert (distances < 0).sum() > 50
    assert sign_disagreements(points, distances, bunny) == 0


def test_every_wrong_sign_is_counted(bunny: Surface) -> None:
    points, distances = _measured(bunny, np.random.default_rng(5).uniform(bunny.vertices.min(axis=0), bunny.vertices.max(axis=0), (400, 3)))
    wrong = np.concatenate([np.flatnonzero(distances < -1e-4)[:7], np.flatnonzero(distances > 1e-4)[:5]])
    distances[wrong] *= -1
    assert sign_disagreements(points, distances, bunny) == 12


def test_where_a_surface_crosses_itself_the_sign_of_its_nearest_part_is_found_out() -> None:
    points, distances = _measured(_balls(0.0, 1.0), np.random.default_rng(6).uniform([-1.2, -1.2, -1.2], [2.2, 1.2, 1.2], (2000, 3)))
    first, second = (_measured(_balls(centre), points)[1] for centre in (0.0, 1.0))
    # Inside one ball and nearer to the other, outside of which it lies: the nearest triangle says outside, the whole surface inside.
    nearest = np.where(np.abs(first) < np.abs(second), first, second)
    deceived = int((((first < 0) | (second < 0)) & (nearest > 0)).sum())
    assert deceived > 50
    assert sign_disagreements(points, distances, _balls(0.0, 1.0)) == deceived
