"""The solids that come with sdfnet."""

import logging
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from sdfnet.errors import ConfigurationError, GeometryError
from sdfnet.geometry.bunny import bunny_path
from sdfnet.geometry.inspection import inspection
from sdfnet.geometry.solids import Box, ClosedSurface, Sphere, kuhn_grid
from sdfnet.geometry.surface import Surface
from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.scene import Geometry


@pytest.mark.parametrize("cells", [(1, 1, 1), (3, 2, 5)])
def test_a_grid_fills_the_unit_cube_with_equal_outward_tets(cells: tuple[int, int, int]) -> None:
    nodes, tets = kuhn_grid(cells)
    mesh = TetMesh(nodes, tets)
    assert len(nodes) == np.prod(np.add(cells, 1))
    np.testing.assert_allclose(mesh.volumes, np.full(6 * np.prod(cells), 1 / (6 * np.prod(cells))), rtol=1e-12)
    assert inspection(mesh.surface()).problems() == []  # cells meet face to face, or inner faces would be left open
    assert len(mesh.boundary_faces) == 4 * (cells[0] * cells[1] + cells[1] * cells[2] + cells[2] * cells[0])


def test_a_box_has_its_size() -> None:
    mesh = Box(size=(0.2, 0.04, 0.03), cells=(5, 2, 3)).tet_mesh()
    np.testing.assert_allclose(mesh.nodes.min(axis=0), 0, atol=0)
    np.testing.assert_allclose(mesh.nodes.max(axis=0), [0.2, 0.04, 0.03], rtol=1e-15)
    assert mesh.volumes.sum() == pytest.approx(0.2 * 0.04 * 0.03, rel=1e-12)


@pytest.mark.parametrize("cells", [3, 8])
def test_a_sphere_lies_on_its_radius_and_nears_its_volume(cells: int) -> None:
    mesh = Sphere(radius=0.05, cells=cells).tet_mesh()
    np.testing.assert_allclose(np.linalg.norm(mesh.nodes[mesh.surface_nodes], axis=1), 0.05, rtol=1e-12)
    missing = 1 - mesh.volumes.sum() / (4 / 3 * np.pi * 0.05**3)
    assert 0 < missing < 4.0 / cells**2  # chords lose a part in proportion to the squared edge


@pytest.mark.parametrize("geometry", [Box(cells=(2, 0, 2)), Sphere(cells=0), Box(cells=(1, -1, 1))])
def test_a_grid_without_cells_is_refused(geometry: Box | Sphere) -> None:
    with pytest.raises(GeometryError, match="geometry.cells must be at least 1 along every axis, found"):
        geometry.tet_mesh()


@pytest.mark.parametrize(
    ("kind", "settings", "message"),
    [
        (Box, {"size": (1.0, 0.0, 1.0)}, r"geometry.size must be positive and finite, found \(1.0, 0.0, 1.0\) m"),
        (Sphere, {"radius": -0.05}, "geometry.radius must be positive and finite, found -0.05 m"),
        (ClosedSurface, {"up_axis": "x"}, "geometry.up_axis must be one of y, z; found 'x'"),
        (ClosedSurface, {"x_extent": 0.0}, "geometry.x_extent must be positive and finite, found 0.0 m; null keeps the size of the file"),
        (ClosedSurface, {"x_extent": -1.0}, "geometry.x_extent must be positive"),
        (ClosedSurface, {"foot_depth": math.nan}, "geometry.foot_depth must be finite, found nan m; null keeps the position of the file"),
        (ClosedSurface, {"edge_length": -0.05}, r"geometry.edge_length must lie in \(0, 1\), a fraction of the bounding box diagonal, found -0.05"),
        (ClosedSurface, {"envelope": 1.0}, r"geometry.envelope must lie in \(0, 1\)"),
        (ClosedSurface, {"stop_energy": 3.0}, "geometry.stop_energy must exceed 3, that of regular tets, and be finite, found 3.0"),
    ],
)
def test_a_solid_that_cannot_be_is_refused(kind: type[Geometry], settings: dict[str, Any], message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        kind(**settings)


def test_without_a_path_the_surface_is_the_bunny() -> None:
    assert ClosedSurface().source() == bunny_path()
    assert len(ClosedSurface().inputs_digest()) == 12


def test_the_inputs_digest_follows_the_bytes_of_the_file() -> None:
    geometry = ClosedSurface(path="solid.obj")
    assert geometry.inputs_digest() == ""
    Path("solid.obj").write_text("one")
    before = geometry.inputs_digest()
    Path("solid.obj").write_text("two")
    assert before != geometry.inputs_digest() != ""
    assert Sphere().inputs_digest() == ""


def test_a_surface_of_ones_own_is_filled_where_it_is_placed() -> None:
    trimesh.creation.icosphere(subdivisions=1, radius=3.0).export("ball.stl")
    mesh = ClosedSurface(path="ball.stl", x_extent=0.2, foot_depth=0.01, edge_length=0.3).tet_mesh()
    lower, upper = mesh.nodes.min(axis=0), mesh.nodes.max(axis=0)
    # fTetWild may leave the surface by the envelope, 1e-3 of the diagonal 0.35 m.
    np.testing.assert_allclose(lower, [0.0, -0.1, -0.01], atol=4e-4)
    np.testing.assert_allclose(upper, [0.2, 0.1, 0.19], atol=4e-4)


@pytest.fixture
def given_to_fill(monkeypatch: pytest.MonkeyPatch) -> list[Surface]:
    """The surfaces that fTetWild would have filled: it takes seconds."""
    given: list[Surface] = []

    def fill(surface: Surface, *_: Any) -> TetMesh:
        given.append(surface)
        return Box().tet_mesh()

    monkeypatch.setattr("sdfnet.geometry.solids.tetrahedralise", fill)
    return given


@pytest.mark.parametrize(
    ("x_extent", "message"),
    [
        (0.2, "'ball.stl' is 0.2 x 0.2 x 0.2 m: its 6 along x are scaled to geometry.x_extent; null keeps its numbers as metres"),
        (None, "'ball.stl' is 6 x 6 x 6 m as its numbers stand; if they are millimetres, set geometry.x_extent=0.006"),
    ],
)
def test_how_large_a_file_is_taken_to_be_is_said(caplog: pytest.LogCaptureFixture, given_to_fill: list[Surface], x_extent: float | None, message: str) -> None:
    trimesh.creation.icosphere(subdivisions=1, radius=3.0).export("ball.stl")
    with caplog.at_level(logging.INFO, logger="sdfnet.geometry.solids"):
        ClosedSurface(path="ball.stl", x_extent=x_extent, edge_length=0.3).tet_mesh()
    assert [record.message for record in caplog.records if record.name == "sdfnet.geometry.solids"] == [message]


def test_an_open_surface_is_refused_by_its_file_name_and_filled_on_request(caplog: pytest.LogCaptureFixture) -> None:
    ball = trimesh.creation.icosphere(subdivisions=1, radius=0.1)
    ball.update_faces(np.arange(len(ball.faces)) > 0)
    ball.export("open.ply")
    geometry = ClosedSurface(path="open.ply", x_extent=None, edge_length=0.3)
    with pytest.raises(GeometryError, match=r"^'open\.ply' must be a closed surface, found 3 open edges"):
        geometry.tet_mesh()
    with caplog.at_level(logging.WARNING):
        filled = replace(geometry, repair=True).tet_mesh()
    assert filled.volumes.sum() == pytest.approx(ball.convex_hull.volume, rel=0.02)  # the hull closes the hole with its flat triangle
    flaws, change = caplog.messages
    assert flaws.startswith("repair: 'open.ply' has 3 open edges at (")
    assert change.startswith("repair: the surface enclosed ")
    assert f"its tets fill {filled.volumes.sum():.4g} m^3, a change of " in change


def _ball() -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions=1, radius=0.1)


def _together(first: trimesh.Trimesh, second: trimesh.Trimesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(np.vstack([first.vertices, second.vertices]), np.vstack([first.faces, second.faces + len(first.vertices)]), process=False)


def _turned_over() -> trimesh.Trimesh:
    return trimesh.Trimesh(_ball().vertices, _ball().faces[:, ::-1])


def _partly_turned() -> trimesh.Trimesh:
    faces = _ball().faces.copy()
    faces[:7] = faces[:7, ::-1]
    return trimesh.Trimesh(_ball().vertices, faces, process=False)


def _two_that_cross() -> trimesh.Trimesh:
    other = _ball().apply_transform(trimesh.transformations.euler_matrix(0.3, 0.5, 0.7)).apply_translation([0.05, 0.0, 0.0])
    return _together(_ball(), other)


def _hollow_all_wrong() -> trimesh.Trimesh:
    cavity = _ball().apply_scale(0.5)
    return _together(_turned_over(), cavity)  # the outer wound inward, the cavity outward


def _two_apart() -> trimesh.Trimesh:
    return _together(_ball(), _ball().apply_translation([0.3, 0.0, 0.0]))


def _two_apart_one_turned_over() -> trimesh.Trimesh:
    return _together(_ball(), _turned_over().apply_translation([0.3, 0.0, 0.0]))


@pytest.mark.parametrize(
    ("made", "flaw", "volume"),
    [
        (_partly_turned, "7 faces wound against their neighbours", 1.0),
        (_two_that_cross, "pairs of faces that cross each other", 1.367),  # two balls less their lens, 1 - 3d/4r + d^3/16r^3 of one, d = r/2
        (_two_apart_one_turned_over, "80 of 160 faces wound inward", 2.0),  # left so, fTetWild would drop it
        (_two_apart, "2 separate bodies of 80, 80 faces, which would fly apart", 2.0),
    ],
)
def test_repair_fills_what_is_flawed_and_tells_the_flaw(
    made: Callable[[], trimesh.Trimesh], flaw: str, volume: float, caplog: pytest.LogCaptureFixture
) -> None:
    made().export("flawed.ply")
    geometry = ClosedSurface(path="flawed.ply", x_extent=None, foot_depth=None, up_axis="z", edge_length=0.3)
    with pytest.raises(GeometryError, match=flaw):
        geometry.tet_mesh()
    with caplog.at_level(logging.WARNING):
        filled = replace(geometry, repair=True).tet_mesh()
    assert flaw in caplog.messages[0]
    assert filled.volumes.sum() == pytest.approx(volume * _ball().volume, rel=0.05)  # 42 vertices a ball: the lens is cut less round


@pytest.mark.parametrize(("made", "faces", "volume"), [(_turned_over, 80, 1.0), (_hollow_all_wrong, 160, 0.875)])
def test_a_surface_that_is_inside_out_is_turned_over_with_a_word(
    made: Callable[[], trimesh.Trimesh], faces: int, volume: float, caplog: pytest.LogCaptureFixture, given_to_fill: list[Surface]
) -> None:
    made().export("inside_out.ply")
    with caplog.at_level(logging.WARNING):
        ClosedSurface(path="inside_out.ply", x_extent=None, foot_depth=None, up_axis="z").tet_mesh()
    assert caplog.messages == [f"'inside_out.ply' is wound inward, all {faces} faces of it, and has no other flaw: it is turned over"]
    assert given_to_fill[0].as_trimesh().volume == pytest.approx(volume * _ball().volume, rel=1e-6)  # eight printed digits


def test_the_repair_of_a_whole_surface_says_that_there_was_no_flaw(caplog: pytest.LogCaptureFixture) -> None:
    _ball().export("whole.ply")
    with caplog.at_level(logging.WARNING):
        ClosedSurface(path="whole.ply", x_extent=None, edge_length=0.3, repair=True).tet_mesh()
    assert caplog.messages[0] == "repair: 'whole.ply' has no flaw; fTetWild fills it all the same"
