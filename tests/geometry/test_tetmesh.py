"""The tet mesh: what it refuses, and its boundary."""

from itertools import combinations

import numpy as np
import pytest

from sdfnet.errors import GeometryError
from sdfnet.geometry.solids import Sphere, kuhn_grid
from sdfnet.geometry.surface import require_closed
from sdfnet.geometry.tetmesh import TetMesh

UNIT = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
ONE = np.array([[0, 1, 2, 3]])


def test_the_measures_of_one_tet_are_the_known_ones() -> None:
    mesh = TetMesh(2 * UNIT, ONE)
    assert mesh.volumes == pytest.approx([8 / 6], rel=1e-15)
    assert mesh.smallest_edge == pytest.approx(2.0, rel=1e-15)
    assert mesh.diagonal == pytest.approx(2 * np.sqrt(3), rel=1e-15)
    assert len(mesh.boundary_faces) == 4


@pytest.mark.parametrize("pair", list(combinations(range(4), 2)))
def test_the_smallest_edge_is_found_wherever_it_is(pair: tuple[int, int]) -> None:
    nodes = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]])  # a regular tet with edges of sqrt 8
    nodes[pair[0]] = nodes[pair[1]] + 0.5 * (nodes[pair[0]] - nodes[pair[1]])
    oriented = ONE if np.linalg.det(nodes[1:] - nodes[0]) > 0 else ONE[:, [0, 2, 1, 3]]
    assert TetMesh(nodes, oriented).smallest_edge == pytest.approx(np.sqrt(2), rel=1e-14)


def test_the_boundary_is_closed_outward_and_encloses_the_tets() -> None:
    mesh = Sphere(radius=0.3, cells=4).tet_mesh()
    surface = mesh.surface()
    require_closed(surface, "ball")
    assert surface.as_trimesh().volume == pytest.approx(mesh.volumes.sum(), rel=1e-12)
    assert len(mesh.surface_nodes) == 5**3 - 3**3
    np.testing.assert_array_equal(mesh.surface_nodes[mesh.surface_faces], mesh.boundary_faces)


def test_a_displaced_surface_moves_each_vertex_with_its_node() -> None:
    mesh = Sphere(cells=3).tet_mesh()
    displacement = np.random.default_rng(0).normal(0, 1e-3, mesh.nodes.shape)
    moved = mesh.surface(displacement)
    np.testing.assert_array_equal(moved.vertices, (mesh.nodes + displacement)[mesh.surface_nodes])
    np.testing.assert_array_equal(moved.faces, mesh.surface().faces)


def test_the_diagonal_leaves_out_nodes_that_no_tet_uses() -> None:
    lonely = np.vstack([UNIT, [[100.0, 0, 0]]])
    assert TetMesh(lonely, ONE).diagonal == pytest.approx(np.sqrt(3), rel=1e-15)


def test_inverted_and_flat_tets_are_counted_and_the_first_is_named() -> None:
    nodes, tets = kuhn_grid((1, 1, 1))
    inverted = tets.copy()
    inverted[2:4] = inverted[2:4, [0, 2, 1, 3]]
    with pytest.raises(GeometryError, match="every tet must have positive volume, found 2 inverted or flat, the first at index 2"):
        TetMesh(nodes, inverted)
    with pytest.raises(GeometryError, match="found 1 inverted or flat, the first at index 0"):
        TetMesh(UNIT * [1, 1, 0], ONE)


def test_an_empty_mesh_and_nodes_that_are_not_finite_are_refused() -> None:
    with pytest.raises(GeometryError, match="at least one tet, found none"):
        TetMesh(UNIT, np.empty((0, 4), dtype=np.int64))
    broken = UNIT.copy()
    broken[1, 0], broken[3, 2] = np.nan, np.inf
    with pytest.raises(GeometryError, match="must be finite, found 2 that are not"):
        TetMesh(broken, ONE)


def test_the_digest_follows_nodes_and_tets_to_the_last_bit() -> None:
    nodes, tets = kuhn_grid((2, 1, 1))
    digest = TetMesh(nodes, tets).digest
    assert TetMesh(nodes.copy(), tets.copy()).digest == digest
    nudged = nodes.copy()
    nudged[0, 0] = np.nextafter(0.0, 1.0)
    assert TetMesh(nudged, tets).digest != digest
    assert TetMesh(nodes, tets[::-1].copy()).digest != digest
