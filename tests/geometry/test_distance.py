"""Signed distance against libigl, on and about every kind of feature of a deforming bunny."""

import inspect

import igl
import numpy as np
import pytest
import torch
import trimesh

from sdfnet.errors import ConfigurationError, GeometryError
from sdfnet.geometry.bunny import bunny_path, place
from sdfnet.geometry.distance import SurfaceDistance, morton_order, signed_distance
from sdfnet.geometry.solids import Sphere
from sdfnet.geometry.surface import Surface, load_surface

AGREEMENT = 1e-6  # m, what the project promises; float32 coordinates of a 0.25 m solid reach 2e-8
COUNT = 1000  # points of a kind and frame


@pytest.fixture(scope="module")
def bunny() -> Surface:
    return place(load_surface(bunny_path()), "y", 0.1551, 0.007)


@pytest.fixture(scope="module")
def frames(bunny: Surface) -> list[np.ndarray]:
    """The bunny at rest, swaying by 1 cm, and leaning over."""
    x, y, z = bunny.vertices.T
    sway = 0.01 * np.stack([np.sin(20 * z), np.zeros_like(z), np.cos(30 * x)], axis=1)
    lean = np.stack([2 * z**2, 0.5 * z * y, -0.3 * z], axis=1)
    return [bunny.vertices, bunny.vertices + sway, bunny.vertices + lean]


@pytest.fixture(scope="module")
def deforming(bunny: Surface) -> SurfaceDistance:
    return SurfaceDistance(bunny)


def _points_about(vertices: np.ndarray, faces: np.ndarray, where: str) -> np.ndarray:
    generator = np.random.default_rng(1)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    corners, normals = vertices[faces], np.asarray(mesh.face_normals)
    chosen, offset = generator.integers(0, len(faces), COUNT), generator.choice([-1e-4, -3e-6, 0.0, 3e-6, 1e-4], (COUNT, 1))
    if where == "box":
        return generator.uniform(vertices.min(axis=0) - 0.05, vertices.max(axis=0) + 0.05, (COUNT, 3))
    if where == "vertices":
        picked = faces[chosen, 0]
        return vertices[picked] + offset * np.asarray(mesh.vertex_normals)[picked]
    if where == "edges":
        return (corners[chosen, 0] + corners[chosen, 1]) / 2 + offset * normals[chosen]
    if where == "faces":
        return corners[chosen].mean(axis=1) + offset * normals[chosen]
    ears = np.flatnonzero(corners[:, :, 2].min(axis=1) > 0.75 * vertices[:, 2].max())
    chosen = generator.choice(ears, COUNT)
    return corners[chosen].mean(axis=1) + generator.normal(0, 2e-3, (COUNT, 3))


def _oracle(points: np.ndarray, vertices: np.ndarray, faces: np.ndarray, sign: igl.SignedDistanceType) -> np.ndarray:
    return np.asarray(igl.signed_distance(points.astype(np.float64), vertices, faces, sign_type=sign)[0])


@pytest.mark.parametrize("where", ["box", "vertices", "edges", "faces", "ears"])
def test_distance_and_sign_agree_with_libigl_in_every_frame(deforming: SurfaceDistance, bunny: Surface, frames: list[np.ndarray], where: str) -> None:
    for vertices in frames:
        points = _points_about(vertices, bunny.faces, where).astype(np.float32)
        deforming.deform(vertices)
        found = deforming.signed_distance(torch.from_numpy(points)).numpy()
        exact = _oracle(points, vertices, bunny.faces, igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL)
        clear = np.abs(exact) > AGREEMENT
        assert clear.sum() > COUNT / 2
        np.testing.assert_allclose(found[clear], exact[clear], atol=AGREEMENT, rtol=0)
        np.testing.assert_allclose(np.abs(found[~clear]), np.abs(exact[~clear]), atol=AGREEMENT, rtol=0)
        assert (exact[clear] < 0).any()
        assert (exact[clear] > 0).any()


def test_signs_agree_with_winding_numbers(deforming: SurfaceDistance, bunny: Surface, frames: list[np.ndarray]) -> None:
    points = np.concatenate([_points_about(frames[1], bunny.faces, where) for where in ("box", "ears")]).astype(np.float32)
    deforming.deform(frames[1])
    found = deforming.signed_distance(torch.from_numpy(points)).numpy()
    winding = igl.winding_number(frames[1], bunny.faces, points.astype(np.float64))
    clear = np.abs(found) > AGREEMENT
    np.testing.assert_array_equal(found[clear] < 0, winding[clear] > 0.5)


def test_far_points_are_right_to_float32(deforming: SurfaceDistance, bunny: Surface, frames: list[np.ndarray]) -> None:
    deforming.deform(frames[0])
    points = (np.random.default_rng(2).normal(size=(200, 3)) * 1e3 * bunny.diagonal).astype(np.float32)
    found = deforming.signed_distance(torch.from_numpy(points)).numpy()
    exact = _oracle(points, frames[0], bunny.faces, igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL)
    np.testing.assert_allclose(found, exact, rtol=4 * float(np.finfo(np.float32).eps))


def test_a_surface_far_from_the_origin_keeps_its_precision(bunny: Surface) -> None:
    shift = np.array([16.0, -32.0, 8.0])  # float32 there has steps of 4e-6 m, the points are exact in it
    points = (np.round(_points_about(bunny.vertices, bunny.faces, "box") * 2**16) / 2**16).astype(np.float32)
    moved = signed_distance(torch.from_numpy((points + shift).astype(np.float32)), Surface(bunny.vertices + shift, bunny.faces))
    torch.testing.assert_close(moved, signed_distance(torch.from_numpy(points), bunny), atol=AGREEMENT, rtol=0)


def test_a_thin_plate_has_an_inside() -> None:
    thickness = 1e-4
    box = trimesh.creation.box((1.0, 1.0, thickness)).subdivide().subdivide()
    plate = Surface(np.asarray(box.vertices, dtype=np.float64), np.asarray(box.faces, dtype=np.int64))
    heights = torch.tensor([-2.0, -0.75, -0.25, 0.0, 0.25, 0.75, 2.0]) * thickness
    points = torch.stack([torch.full_like(heights, 0.1), torch.full_like(heights, -0.23), heights], dim=1)
    torch.testing.assert_close(signed_distance(points, plate), heights.abs() - thickness / 2, atol=2e-7, rtol=0)  # float32 steps at 1 m: 1e-7


def test_points_exactly_on_a_corner_an_edge_or_a_face_have_distance_nought_and_a_side_a_step_away() -> None:
    cube = trimesh.creation.box((2.0, 2.0, 2.0))
    surface = Surface(np.asarray(cube.vertices, dtype=np.float64), np.asarray(cube.faces, dtype=np.int64))
    on = torch.tensor([[1.0, 1, 1], [-1, 1, -1], [1, 1, 0.3], [-1, 0.5, 1], [1, 0.2, 0.1], [0.5, 0.5, -1], [0, 0, 1]])  # corners, edges, faces, a diagonal
    rounding, step = 2e-7, 2.0**-20  # float32 steps at 1 m: 1e-7
    assert signed_distance(on, surface).abs().max() <= rounding
    outward = on.sign() * (on.abs() == 1)
    beyond = signed_distance(on + step * outward, surface)
    torch.testing.assert_close(beyond, step * outward.norm(dim=1), atol=rounding, rtol=0)
    torch.testing.assert_close(signed_distance(on - step * outward, surface), torch.full((len(on),), -step), atol=rounding, rtol=0)


def test_between_two_sheets_a_ten_thousandth_of_the_diagonal_apart_the_sign_is_right() -> None:
    leaf = trimesh.creation.icosphere(subdivisions=4)  # a bent ear: an ellipsoid flattened to that thickness
    x, y, z = np.asarray(leaf.vertices).T
    gap = 1e-4 * 2 * np.sqrt(2)
    ear = Surface(np.stack([x, y, 0.5 * gap * z + 0.3 * x**2 - 0.2 * x * y], axis=1), np.asarray(leaf.faces, dtype=np.int64))
    generator = np.random.default_rng(5)
    corners = ear.vertices[generator.permutation(ear.faces)[:2000]]
    points = (corners.mean(axis=1) + generator.uniform(-1.0, 1.0, (2000, 1)) * [0.0, 0.0, gap]).astype(np.float32)
    found = signed_distance(torch.from_numpy(points), ear).numpy()
    clear = np.abs(found) > AGREEMENT
    inside = igl.winding_number(ear.vertices, ear.faces, points.astype(np.float64))[clear] > 0.5
    np.testing.assert_array_equal(found[clear] < 0, inside)
    assert 0.1 < inside.mean() < 0.9
    assert clear.mean() > 0.9


def test_about_sharp_edges_and_tips_the_sign_is_right() -> None:
    corners = np.array([[0.0, 0, 0], [1, 0.05, 0], [0.9, -0.2, 0.1], [0.5, 0, 0.02]])  # a splinter: a face's own normal is wrong beyond its edges and tips
    hull = trimesh.convex.convex_hull(corners)
    splinter = Surface(np.asarray(hull.vertices, dtype=np.float64), np.asarray(hull.faces, dtype=np.int64))
    points = np.random.default_rng(4).uniform(-0.2, 1.2, (20_000, 3)).astype(np.float32)
    beyond = np.einsum("pfx,fx->pf", points[:, None] - hull.triangles_center, hull.face_normals).max(axis=1)  # of a convex solid: inside if behind all planes
    found = signed_distance(torch.from_numpy(points), splinter).numpy()
    clear = np.abs(beyond) > AGREEMENT
    np.testing.assert_array_equal(found[clear] < 0, beyond[clear] < 0)


def test_negative_is_inside() -> None:
    ball = trimesh.creation.icosphere(subdivisions=3)
    surface = Surface(np.asarray(ball.vertices, dtype=np.float64), np.asarray(ball.faces, dtype=np.int64))
    distances = signed_distance(torch.tensor([[0.0, 0.0, 0.0], [2.0, 0.0, 0.0]]), surface)
    torch.testing.assert_close(distances, torch.tensor([-1.0, 1.0]), atol=0.01, rtol=0)  # chords of 642 vertices cut in by 0.7 %


def test_an_upper_bound_changes_nothing(deforming: SurfaceDistance, bunny: Surface, frames: list[np.ndarray]) -> None:
    deforming.deform(frames[2])
    points = torch.from_numpy(np.concatenate([_points_about(frames[2], bunny.faces, where) for where in ("box", "vertices", "faces")]).astype(np.float32))
    free = deforming.signed_distance(points)
    for slack in (0.0, 1e-3):  # zero: the bound is the distance itself
        torch.testing.assert_close(deforming.signed_distance(points, free.abs() + slack), free, atol=0, rtol=0)


def test_a_bound_that_excludes_the_surface_is_an_error(deforming: SurfaceDistance, frames: list[np.ndarray]) -> None:
    deforming.deform(frames[0])
    points = torch.tensor([[1.0, 1.0, 1.0], [0.08, 0.0, 0.05]])
    with pytest.raises(GeometryError, match="1 of 2 points found no surface within their bound"):
        deforming.signed_distance(points, torch.tensor([0.1, 1.0]))
    with pytest.raises(GeometryError, match="1 of 2 points found no surface"):
        deforming.signed_distance(torch.tensor([[torch.nan, 0.0, 0.0], [0.0, 0.0, 0.0]]))


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_vertex_that_is_not_finite_is_refused_before_anything_is_asked(bunny: Surface, bad: float) -> None:
    broken = bunny.vertices.copy()
    broken[[7, 9], 1] = bad
    message = "surface vertices must be finite, found 2 that are not, the first at index 7; find where the solid diverged"
    with pytest.raises(GeometryError, match=message):
        SurfaceDistance(Surface(broken, bunny.faces))
    with pytest.raises(GeometryError, match=message):
        SurfaceDistance(bunny).deform(broken)


def test_many_points_split_over_threads_give_what_few_give(deforming: SurfaceDistance, bunny: Surface, frames: list[np.ndarray]) -> None:
    deforming.deform(frames[0])
    points = torch.rand(20_001, 3) * 0.2
    pieces = torch.cat([deforming.signed_distance(part) for part in points.split(3000)])
    torch.testing.assert_close(deforming.signed_distance(points), pieces, atol=0, rtol=0)
    assert deforming.signed_distance(points[:0]).shape == (0,)


def test_back_at_rest_a_deformed_surface_answers_as_a_new_one(bunny: Surface, frames: list[np.ndarray]) -> None:
    used = SurfaceDistance(bunny)
    used.deform(frames[2])
    used.deform(frames[0])
    points = torch.from_numpy(_points_about(frames[0], bunny.faces, "box").astype(np.float32))
    torch.testing.assert_close(used.signed_distance(points), signed_distance(points, bunny), atol=1e-8, rtol=0)


def test_closest_gives_the_triangle_its_normal_and_the_distance(deforming: SurfaceDistance, bunny: Surface, frames: list[np.ndarray]) -> None:
    deforming.deform(frames[1])
    mesh = trimesh.Trimesh(frames[1], bunny.faces, process=False)
    corners = frames[1][bunny.faces[::7]]
    inside = np.sqrt(np.asarray(mesh.area_faces)[::7]) > 5e-4  # a 1e-5 m step off a smaller face may meet its neighbour
    points = torch.from_numpy((corners.mean(axis=1) + 1e-5 * mesh.face_normals[::7]).astype(np.float32))
    closest = deforming.closest(points, within=0.01)
    torch.testing.assert_close(closest.distance, deforming.signed_distance(points).abs(), atol=0, rtol=0)
    expected = np.arange(len(bunny.faces))[::7]
    agree = closest.face.numpy() == expected
    assert agree[inside].mean() > 0.95  # in a crease another face may be nearer
    np.testing.assert_allclose(closest.normals.numpy(), mesh.face_normals[closest.face.numpy()], atol=1e-6)


def test_beyond_its_radius_closest_says_that_there_is_nothing(deforming: SurfaceDistance, frames: list[np.ndarray]) -> None:
    deforming.deform(frames[0])
    closest = deforming.closest(torch.tensor([[1.0, 1.0, 1.0]]), within=0.1)
    assert closest.face.tolist() == [-1]
    assert closest.distance.tolist() == pytest.approx([0.1])


@pytest.mark.parametrize("is_fin", [False, True], ids=["hole", "edge of four faces"])
def test_an_open_surface_is_refused_unless_only_closest_is_wanted(is_fin: bool) -> None:
    ball = trimesh.creation.icosphere(subdivisions=1)
    first, second = ball.faces[0, :2]
    vertices = np.vstack([ball.vertices, [2.0, 2.0, 2.0]])
    faces = np.vstack([ball.faces, [[first, second, 42], [second, first, 42]]]) if is_fin else ball.faces[1:]
    surface = Surface(vertices, faces.astype(np.int64))
    with pytest.raises(GeometryError, match="needs a closed surface, every edge shared by exactly two faces; repair"):
        SurfaceDistance(surface)
    assert SurfaceDistance(surface, is_closed=False).closest(torch.zeros(1, 3), within=2.0).distance.item() < 1


def test_morton_order_is_a_permutation_that_puts_neighbours_together() -> None:
    points = np.random.default_rng(3).random((5000, 3)).astype(np.float32)
    order = morton_order(points)
    np.testing.assert_array_equal(np.sort(order), np.arange(5000))
    steps = np.linalg.norm(np.diff(points[order], axis=0), axis=1).mean()
    assert steps < 0.2 * np.linalg.norm(np.diff(points, axis=0), axis=1).mean()  # 5000 points are 0.06 apart, random pairs 0.66


def test_morton_order_of_eight_corners_counts_in_binary() -> None:
    corners = np.array([[k >> 2 & 1, k >> 1 & 1, k & 1] for k in (5, 3, 7, 0, 6, 1, 4, 2)], dtype=np.float32)
    np.testing.assert_array_equal(corners[morton_order(corners)] @ [4, 2, 1], np.arange(8))


def test_morton_order_takes_a_flat_set_and_equal_points() -> None:
    flat = np.zeros((10, 3), dtype=np.float32)
    flat[:, 0] = np.arange(10)[::-1]
    np.testing.assert_array_equal(morton_order(flat), np.arange(10)[::-1])
    np.testing.assert_array_equal(morton_order(np.zeros((4, 3), dtype=np.float32)), np.arange(4))


def test_points_may_be_an_array_or_lists_and_need_three_columns() -> None:
    distance = SurfaceDistance(Sphere(radius=1.0, cells=2).tet_mesh().surface())
    ask = inspect.unwrap(SurfaceDistance.signed_distance)  # as users have it: the check of types is the tests' own
    expected = distance.signed_distance(torch.tensor([[0.1, 0.2, 0.0]]))
    for points in (np.array([[0.1, 0.2, 0.0]]), [[0.1, 0.2, 0.0]], torch.tensor([[0.1, 0.2, 0.0]], dtype=torch.float64)):
        torch.testing.assert_close(ask(distance, points), expected)
    with pytest.raises(GeometryError, match=r"points must have the shape \(points, 3\), found \(3,\); for a single point write \[\[x, y, z\]\]"):
        ask(distance, np.zeros(3))


def test_a_surface_deforms_into_as_many_vertices_as_it_has() -> None:
    surface = Sphere(cells=2).tet_mesh().surface()
    distance, deform = SurfaceDistance(surface), inspect.unwrap(SurfaceDistance.deform)
    with pytest.raises(GeometryError, match=r"a surface that deforms keeps its 26 vertices, found 27; give those of Trajectory\.surface\(frame\)"):
        distance.deform(np.zeros((27, 3)))
    with pytest.raises(ConfigurationError, match=r"vertices must be an array \(vertices, 3\) of numbers, found an array \(5, 26, 3\) of float64"):
        deform(distance, np.zeros((5, 26, 3)))
    deform(distance, torch.from_numpy(2 * surface.vertices))
    assert float(distance.signed_distance(torch.zeros(1, 3))) == pytest.approx(2 * float(SurfaceDistance(surface).signed_distance(torch.zeros(1, 3))), rel=1e-6)
