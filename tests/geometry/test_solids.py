"""The solids that come with sdfnet."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

from sdfnet.errors import GeometryError
from sdfnet.geometry.bunny import bunny_path
from sdfnet.geometry.solids import Box, ClosedSurface, Sphere, kuhn_grid
from sdfnet.geometry.surface import require_closed
from sdfnet.geometry.tetmesh import TetMesh


@pytest.mark.parametrize("cells", [(1, 1, 1), (3, 2, 5)])
def test_a_grid_fills_the_unit_cube_with_equal_outward_tets(cells: tuple[int, int, int]) -> None:
    nodes, tets = kuhn_grid(cells)
    mesh = TetMesh(nodes, tets)
    assert len(nodes) == np.prod(np.add(cells, 1))
    np.testing.assert_allclose(mesh.volumes, np.full(6 * np.prod(cells), 1 / (6 * np.prod(cells))), rtol=1e-12)
    require_closed(mesh.surface(), "grid")  # cells meet face to face, or inner faces would be left open
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


def test_a_solid_without_extent_is_refused() -> None:
    with pytest.raises(GeometryError, match="inverted or flat"):
        Box(size=(1.0, 0.0, 1.0)).tet_mesh()


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


def test_an_open_surface_is_refused_by_its_file_name_and_filled_on_request() -> None:
    ball = trimesh.creation.icosphere(subdivisions=1, radius=0.1)
    ball.update_faces(np.arange(len(ball.faces)) > 0)
    ball.export("open.ply")
    geometry = ClosedSurface(path="open.ply", x_extent=None, edge_length=0.3)
    with pytest.raises(GeometryError, match=r"^'open\.ply' must be a closed surface, found 3 open edges"):
        geometry.tet_mesh()
    filled = replace(geometry, repair=True).tet_mesh()
    assert filled.volumes.sum() == pytest.approx(ball.convex_hull.volume, rel=0.02)  # the hull closes the hole with its flat triangle
