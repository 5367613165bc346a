"""What keeps a surface from bounding one solid, and where."""

import re

import numpy as np
import pytest
import trimesh

from sdfnet.errors import GeometryError
from sdfnet.geometry.inspection import Flaw, Inspection, closed_outward, inspection
from sdfnet.geometry.surface import Surface

UNIT_CORNERS = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 1]])


def _ball() -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=1, radius=0.1)


def _surface(mesh: trimesh.Trimesh) -> Surface:
    return Surface(np.array(mesh.vertices, dtype=np.float64), np.array(mesh.faces, dtype=np.int64))


def test_a_ball_has_no_problem() -> None:
    found = inspection(_surface(_ball()))
    assert found == Inspection(faces=80, bodies=(80,))
    assert found.problems() == []


def test_an_open_surface_is_refused_with_its_open_edges_and_the_cure() -> None:
    ball = _ball()
    middles = ball.vertices[ball.faces[0]] + np.roll(ball.vertices[ball.faces[0]], -1, axis=0)
    ball.update_faces(np.arange(len(ball.faces)) > 0)
    with pytest.raises(GeometryError, match=r"^'ear' must be a closed surface, found 3 open edges at .*; mend it .*geometry\.repair=true") as caught:
        closed_outward(_surface(ball), "'ear'")
    for x, y, z in middles / 2:
        assert f"({x:.4g}, {y:.4g}, {z:.4g})" in str(caught.value)


def test_of_many_open_edges_three_are_placed() -> None:
    flat = Surface(UNIT_CORNERS * [1, 1, 0], np.array([[0, 1, 2], [1, 3, 2]]))
    assert inspection(flat).open_edges.count == 4
    (problem,) = inspection(flat).problems()
    assert problem == "4 open edges such as at (0.5, 0, 0), (0, 0.5, 0), (1, 0.5, 0) m"


def test_an_edge_of_more_than_two_faces_is_refused_counted_and_placed() -> None:
    ball = _ball()
    # A fin: a flat pair of triangles, back to back, on one edge.
    vertices = np.vstack([ball.vertices, [0.2, 0.2, 0.2]])
    first, second = ball.faces[0, :2]
    faces = np.vstack([ball.faces, [[first, second, 42], [second, first, 42]]])
    x, y, z = vertices[[first, second]].mean(axis=0)
    with pytest.raises(GeometryError, match=re.escape(f"found 1 edge shared by more than two faces at ({x:.4g}, {y:.4g}, {z:.4g}) m; mend")):
        closed_outward(Surface(vertices, faces.astype(np.int64)), "fin")


@pytest.mark.parametrize("turned", [1, 5])
def test_faces_wound_against_the_rest_are_refused_counted_and_placed(turned: int) -> None:
    surface = _surface(_ball())
    faces = surface.faces.copy()
    faces[-turned:] = faces[-turned:, ::-1]
    x, y, z = surface.vertices[faces[-turned]].mean(axis=0)
    words = f"found {turned} face{'s' if turned > 1 else ''} wound against {'their' if turned > 1 else 'its'} neighbours"
    with pytest.raises(GeometryError, match=rf"{words} .*{re.escape(f'({x:.4g}, {y:.4g}, {z:.4g})')}.* m; mend"):
        closed_outward(Surface(surface.vertices, faces), "ball")


def test_the_larger_part_by_count_says_which_way_the_rest_is_turned() -> None:
    ball = _surface(_ball())
    vertices, fine = list(ball.vertices), [ball.faces[0]]
    for _ in range(50):  # one face cut finely has most faces, and nearly none of the volume
        a, b, c = fine.pop(0)
        middle = len(vertices)
        vertices.append((vertices[a] + vertices[b] + vertices[c]) / 3)
        fine += [np.array([a, b, middle]), np.array([b, c, middle]), np.array([c, a, middle])]
    found = inspection(Surface(np.array(vertices), np.vstack([*fine, ball.faces[1:, ::-1]])))
    assert (found.turned_faces.count, found.inward_faces.count) == (79, 0)


def test_a_surface_turned_over_whole_is_wound_inward() -> None:
    surface = _surface(_ball())
    faces = surface.faces[:, ::-1].copy()
    (problem,) = inspection(Surface(surface.vertices, faces)).problems()
    assert problem.startswith("80 of 80 faces wound inward such as at (")
    faces[0] = faces[0, ::-1]
    assert [problem.split(" at ")[0] for problem in inspection(Surface(surface.vertices, faces)).problems()] == [
        "1 face wound against its neighbours",
        "80 of 80 faces wound inward such as",
    ]


def test_only_what_is_wound_inward_as_a_whole_and_sound_otherwise_is_turned_over() -> None:
    surface = _surface(_ball())
    assert closed_outward(surface, "ball") is surface
    turned = closed_outward(Surface(surface.vertices, surface.faces[:, ::-1].copy()), "ball")
    np.testing.assert_array_equal(turned.faces, surface.faces)
    faces = surface.faces[:, ::-1].copy()
    two = Surface(np.vstack([surface.vertices, surface.vertices + 1.0]), np.vstack([faces, faces + 42]))
    filled = Surface(np.vstack([surface.vertices, 0.5 * surface.vertices]), np.vstack([surface.faces, surface.faces + 42]))
    for flawed, flaw in ((two, "2 separate bodies"), (filled, "80 of 160 faces"), (Surface(surface.vertices, faces[1:]), "3 open edges")):
        with pytest.raises(GeometryError, match=flaw):
            closed_outward(flawed, "ball")


def test_a_surface_that_crosses_itself_is_refused_with_count_and_places() -> None:
    box, spike = trimesh.creation.box(), trimesh.creation.cone(0.05, 1.0, sections=6)
    spike.apply_translation([0.13, 0.21, 0.1])  # through the top at z = 0.5
    with pytest.raises(
        GeometryError, match=r"found 6 pairs of faces that cross each other such as at \(0\.\d+, 0\.\d+, 0\.5\), .* m; 2 separate bodies of 12, 12 faces"
    ):
        closed_outward(Surface(np.vstack([box.vertices, spike.vertices]), np.vstack([box.faces, spike.faces + 8]).astype(np.int64)), "box")


@pytest.mark.parametrize("scale", [1e-3, 1.0])
def test_vertices_almost_upon_another_are_found_whatever_the_scale(scale: float) -> None:
    ball = _surface(_ball())
    vertices, faces = np.vstack([ball.vertices, ball.vertices[:1]]), ball.faces.copy()
    corner = np.argwhere(faces == 0)[0]
    faces[tuple(corner)] = 42
    for gap, count in ((0.0, 2), (0.5e-9, 2), (3e-9, 0)):
        vertices[42, 0] = vertices[0, 0] + gap * ball.diagonal
        found = inspection(Surface(scale * vertices, faces))
        assert found.near_vertices.count == count
        assert found.open_edges.count == 4  # two edges of the face that was cut loose, two of its neighbours
    vertices[42] = vertices[0]
    x, y, z = scale * vertices[0]
    with pytest.raises(GeometryError, match=re.escape(f"2 vertices almost upon another at ({x:.4g}, {y:.4g}, {z:.4g}), ")):
        closed_outward(Surface(scale * vertices, faces), "cracked")


@pytest.mark.parametrize("scale", [1e-3, 1.0])
def test_faces_without_area_are_found_whatever_the_scale(scale: float) -> None:
    box = trimesh.creation.box()
    first, second, third = box.faces[0]
    vertices = np.vstack([box.vertices, (box.vertices[first] + box.vertices[second]) / 2])
    faces = np.vstack([box.faces[1:], [[first, 8, third], [8, second, third], [first, second, 8]]])  # the last is flat and closes the surface
    found = inspection(Surface(scale * vertices, faces.astype(np.int64)))
    assert found.flat_faces == Flaw(1, (tuple(scale * vertices[[first, second, 8]].mean(axis=0)),))
    x, y, z = found.flat_faces.places[0]
    assert found.problems() == [f"1 face without area at ({x:.4g}, {y:.4g}, {z:.4g}) m"]
    for gap, count in ((0.5e-9, 1), (1.5e-9, 0)):  # parts of the diagonal by which the middle vertex leaves the line
        bent = vertices.copy()
        bent[8] += gap * np.linalg.norm(np.ptp(box.vertices, axis=0)) * box.face_normals[0]
        assert inspection(Surface(scale * bent, faces.astype(np.int64))).flat_faces.count == count
    doubled = np.vstack([box.faces, [[first, first, second]]])  # names a vertex twice
    assert inspection(Surface(scale * np.asarray(box.vertices), doubled.astype(np.int64))).problems()[0].startswith("1 face without area at (")


def test_a_thin_face_is_no_face_without_area() -> None:
    plate = trimesh.creation.box((1.0, 1.0, 1e-6))  # thinner than any scan, its sides 1e-6 high
    assert inspection(_surface(plate)).problems() == []


def test_two_bodies_are_refused_with_their_sizes_because_they_would_fly_apart() -> None:
    ball, small = _surface(_ball()), trimesh.creation.box((0.1, 0.1, 0.1))
    two = Surface(np.vstack([small.vertices + 1.0, ball.vertices]), np.vstack([small.faces, ball.faces + 8]).astype(np.int64))
    with pytest.raises(GeometryError, match=r"found 2 separate bodies of 80, 12 faces, which would fly apart .* \(keep one, or join them\); mend"):
        closed_outward(two, "two")


def test_a_cavity_is_no_second_body_and_is_wound_the_other_way() -> None:
    ball = _surface(_ball())
    vertices, inner = np.vstack([ball.vertices, 0.5 * ball.vertices, 0.2 * ball.vertices]), ball.faces[:, ::-1] + 42
    assert inspection(Surface(vertices, np.vstack([ball.faces, inner]))).problems() == []
    filled = inspection(Surface(vertices, np.vstack([ball.faces, ball.faces + 42])))
    assert (filled.bodies, filled.inward_faces.count) == ((80,), 80)
    loose = inspection(Surface(vertices, np.vstack([ball.faces, inner, ball.faces + 84])))  # a ball in the cavity
    assert (loose.bodies, loose.inward_faces.count) == ((80, 80), 0)


def test_all_problems_are_told_at_once() -> None:
    ball, other = _surface(_ball()), _surface(_ball())
    faces = np.vstack([ball.faces[1:], other.faces[:, ::-1] + 42])
    problems = inspection(Surface(np.vstack([ball.vertices, other.vertices + [0.07, 0.05, 0.03]]), faces)).problems()
    assert [re.sub(r"[^a-z ]", "", problem.split(" at ")[0]).strip() for problem in problems[:3]] == [
        "open edges",
        "of  faces wound inward such as",
        "pairs of faces that cross each other such as",
    ]
    assert "2 separate bodies" in problems[3]


def test_nothing_and_numbers_that_are_not_finite_are_problems() -> None:
    with pytest.raises(GeometryError, match="'none' must be a closed surface, found no triangles"):
        closed_outward(Surface(UNIT_CORNERS, np.empty((0, 3), dtype=np.int64)), "'none'")
    ball = _surface(_ball())
    ball.vertices[3, 1], ball.vertices[7] = np.nan, np.inf
    with pytest.raises(GeometryError, match="'broken' must be a closed surface, found 2 vertices that are not finite; mend"):
        closed_outward(ball, "'broken'")
