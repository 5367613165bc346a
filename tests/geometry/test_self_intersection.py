"""Faces that cross, against every pair of faces solved one by one."""

import time
from collections.abc import Callable

import numpy as np
import pytest
import trimesh

from sdfnet.errors import GeometryError
from sdfnet.geometry.bunny import bunny_path
from sdfnet.geometry.self_intersection import SelfIntersectionSearch, self_intersections
from sdfnet.geometry.surface import Surface, load_surface


def _surface(*meshes: trimesh.Trimesh) -> Surface:
    first = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes)])
    faces = np.vstack([mesh.faces + start for mesh, start in zip(meshes, first[:-1], strict=True)])
    return Surface(np.vstack([mesh.vertices for mesh in meshes]), faces.astype(np.int64))


def _turned(mesh: trimesh.Trimesh, shift: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> trimesh.Trimesh:
    """In general position, so that no edge meets another exactly."""
    return mesh.copy().apply_transform(trimesh.transformations.euler_matrix(0.3, 0.5, 0.7)).apply_translation(shift)


def _goes_through(start: np.ndarray, end: np.ndarray, triangle: np.ndarray) -> bool:
    """Whether the segment meets the triangle: start + s (end - start) = a + u (b - a) + v (c - a), solved for s, u, v."""
    a, b, c = triangle
    matrix = np.stack([start - end, b - a, c - a], axis=1)
    if abs(np.linalg.det(matrix)) < 1e-14:
        return False
    s, u, v = np.linalg.solve(matrix, start - a)
    return bool(0 < s < 1 and u >= 0 and v >= 0 and u + v <= 1)


def _every_crossing(surface: Surface) -> list[tuple[int, int]]:
    """The crossing pairs by trying all pairs whose boxes overlap, edge by edge."""
    corners, found = surface.vertices[surface.faces], []
    lower, upper = corners.min(axis=1), corners.max(axis=1)
    meets = (lower[:, None] <= upper).all(axis=-1)
    for i, j in np.argwhere(np.triu(meets & meets.T, 1)).tolist():
        shared = set(surface.faces[i]) & set(surface.faces[j])
        if len(shared) > 1:
            continue
        for own, other in ((i, j), (j, i)):
            for k in range(3):
                start, end = surface.faces[own, k], surface.faces[own, (k + 1) % 3]
                if start not in shared and end not in shared and _goes_through(surface.vertices[start], surface.vertices[end], corners[other]):
                    found.append((i, j))
    return sorted(set(found))


def _soup(seed: int) -> Surface:
    """Thirty vertices at random and eighty faces among them: many pairs share a corner, many cross."""
    generator = np.random.default_rng(seed)
    faces = np.stack([generator.choice(30, 3, replace=False) for _ in range(80)])
    return Surface(generator.random((30, 3)), faces.astype(np.int64))


def _crumpled(seed: int) -> Surface:
    """A ball whose vertices are thrown about by a third of its radius."""
    ball = trimesh.creation.icosphere(subdivisions=2)
    return Surface(ball.vertices + np.random.default_rng(seed).normal(0, 0.15, ball.vertices.shape), ball.faces.astype(np.int64))


def _pushed_through() -> Surface:
    """A ball whose upper half is pushed down through the lower."""
    ball = _turned(trimesh.creation.icosphere(subdivisions=3))
    vertices = np.array(ball.vertices)
    dent = np.exp(-8 * (vertices[:, 0] ** 2 + vertices[:, 1] ** 2))
    vertices[:, 2] -= np.where(vertices[:, 2] > 0, 2.5 * dent, 0.0)
    return Surface(vertices, ball.faces.astype(np.int64))


@pytest.mark.parametrize("seed", range(2))
@pytest.mark.parametrize("made", [_soup, _crumpled])
def test_the_pairs_are_those_of_trying_every_pair(made: Callable[[int], Surface], seed: int) -> None:
    surface = made(seed)
    expected = _every_crossing(surface)
    assert len(expected) > 10
    found = self_intersections(surface)
    assert [tuple(pair) for pair in found.pairs.tolist()] == expected
    assert found.count == len(expected)


@pytest.mark.parametrize("part", [trimesh.creation.icosphere(subdivisions=2), trimesh.creation.box().subdivide()], ids=["balls", "boxes"])
def test_two_solids_that_interpenetrate_cross_along_their_common_ring(part: trimesh.Trimesh) -> None:
    surface = _surface(part, _turned(part, (0.4, 0.3, 0.2)))
    found = self_intersections(surface)
    assert [tuple(pair) for pair in found.pairs.tolist()] == _every_crossing(surface)
    assert (found.pairs[:, 0] < len(part.faces)).all()  # each pair has a face of either solid
    assert (found.pairs[:, 1] >= len(part.faces)).all()


def test_a_spike_through_a_face_crosses_it_three_times_at_the_place() -> None:
    spike = trimesh.Trimesh([[0.05, -0.02, 0.0], [0.0, 0.06, 2.0], [0.05, -0.06, 2.0], [-0.06, -0.03, 2.0]], [[0, 2, 1], [0, 3, 2], [0, 1, 3], [1, 2, 3]])
    spike.apply_translation([0.2, -0.1, 0.0])
    found = self_intersections(_surface(trimesh.creation.box(), spike))  # its tip in the box, its foot above the top at z = 0.5
    assert found.count == 3
    assert len(set(found.pairs[:, 0].tolist())) == 1
    np.testing.assert_allclose(found.places[:, 2], 0.5, atol=1e-12)
    np.testing.assert_allclose(found.places[:, :2], [[0.23, -0.12]] * 3, atol=0.03)  # a quarter of the way up a spike 0.12 wide


def test_a_ball_pushed_through_itself_crosses_in_a_ring_below() -> None:
    surface = _pushed_through()
    found = self_intersections(surface)
    assert [tuple(pair) for pair in found.pairs.tolist()] == _every_crossing(surface)
    assert found.count > 20
    radius = np.hypot(found.places[:, 0], found.places[:, 1])
    # Where 2 sqrt(1 - r^2) = 2.5 exp(-8 r^2): the dent leaves the ball; edges are 0.15 long.
    assert radius == pytest.approx(0.17, abs=0.08)
    assert found.places[:, 2] == pytest.approx(-np.sqrt(1 - radius**2), abs=0.02)  # chords of 0.15 cut in by 0.003


def test_two_faces_with_one_common_corner_cross_where_the_opposite_edge_goes_through() -> None:
    vertices = np.array([[0.0, 0, 0], [2, 1, 0], [2, -1, 0], [1, 0, 1], [1, 0, -1]])
    found = self_intersections(Surface(vertices, np.array([[0, 1, 2], [4, 0, 3]])))
    assert found.pairs.tolist() == [[0, 1]]
    np.testing.assert_allclose(found.places, [[0.5, 0, 0]], atol=1e-15)  # the middle from the corner to (1, 0, 0)
    apart = np.array([[0.0, 0, 0], [2, 1, 0], [2, -1, 0], [-1, 0, 1], [-1, 0, -1]])
    assert self_intersections(Surface(apart, np.array([[0, 1, 2], [4, 0, 3]]))).count == 0


def test_a_clean_ball_and_the_bunny_cross_nowhere() -> None:
    assert self_intersections(_surface(trimesh.creation.icosphere(subdivisions=4))).count == 0
    assert self_intersections(load_surface(bunny_path())).count == 0


@pytest.mark.parametrize("shift", [0.0, 1e3])
def test_flat_faces_that_meet_in_one_plane_do_not_cross(shift: float) -> None:
    """Turned and shifted, a box's faces lie off their plane by rounding, on either side."""
    box = _turned(trimesh.creation.box().subdivide().subdivide(), (shift, shift, -shift))
    assert self_intersections(_surface(box)).count == 0
    stacked = _surface(box, box.copy().apply_translation(box.facets_normal[0] * 1.0))  # face upon face
    assert self_intersections(stacked).count == 0


def test_a_face_without_area_crosses_nothing() -> None:
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0.2, 0.2, -1], [0.2, 0.2, 1], [0.2, 0.2, 0.5]])
    assert self_intersections(Surface(vertices, np.array([[0, 1, 2], [3, 4, 5]]))).count == 1  # its edge goes through the other face
    assert self_intersections(Surface(vertices + [0, 0, 3], np.array([[0, 0, 0], [3, 4, 5]]))).count == 0


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_the_unit_of_length_does_not_matter(scale: float) -> None:
    surface = _crumpled(7)
    found, scaled = self_intersections(surface), self_intersections(Surface(scale * surface.vertices, surface.faces))
    np.testing.assert_array_equal(scaled.pairs, found.pairs)
    np.testing.assert_allclose(scaled.places, scale * found.places, rtol=1e-9)


def test_far_from_the_origin_the_pairs_are_the_same() -> None:
    surface = _pushed_through()
    found, moved = self_intersections(surface), self_intersections(Surface(surface.vertices + 1e4, surface.faces))
    np.testing.assert_array_equal(moved.pairs, found.pairs)
    np.testing.assert_allclose(moved.places, found.places + 1e4, atol=1e-9)  # float64 steps at 1e4: 2e-12


def test_a_refitted_search_finds_what_a_new_one_finds() -> None:
    crossed, clean = _pushed_through(), _turned(trimesh.creation.icosphere(subdivisions=3))
    search = SelfIntersectionSearch(_surface(clean))
    assert search.count() == 0
    search.deform(crossed.vertices + 5.0)  # a frame may also have flown away
    np.testing.assert_array_equal(search.find().pairs, self_intersections(crossed).pairs)
    assert search.count() == self_intersections(crossed).count
    search.deform(np.array(clean.vertices))
    assert search.count() == 0


def test_the_list_is_capped_and_the_count_is_not() -> None:
    surface = _soup(0)
    whole, capped = self_intersections(surface), SelfIntersectionSearch(surface, listed=5).find()
    assert capped.count == whole.count > 5
    assert len(capped.pairs) == len(capped.places) == 5
    assert {tuple(pair) for pair in capped.pairs.tolist()} <= {tuple(pair) for pair in whole.pairs.tolist()}


def test_no_faces_and_vertices_that_are_not_finite_are_refused() -> None:
    with pytest.raises(GeometryError, match="at least one face, found none"):
        self_intersections(Surface(np.zeros((3, 3)), np.empty((0, 3), dtype=np.int64)))
    surface = _soup(1)
    search = SelfIntersectionSearch(surface)
    broken = surface.vertices.copy()
    broken[3, 1], broken[4] = np.nan, np.inf
    with pytest.raises(GeometryError, match="need finite vertices, found 2 that are not"):
        search.deform(broken)


def test_nine_thousand_faces_are_fast_enough_to_ask_every_frame() -> None:
    ball = trimesh.creation.icosphere(subdivisions=4)  # 5,120 faces
    surface = _surface(ball, ball.copy().apply_translation([3.0, 0, 0]))
    search, seconds = SelfIntersectionSearch(surface), []
    search.count()  # compiles
    for _ in range(5):
        began = time.perf_counter()
        search.deform(surface.vertices)
        search.count()
        seconds.append(time.perf_counter() - began)
    assert min(seconds) < 0.05  # 10,240 faces; the least of five, because other work disturbs
