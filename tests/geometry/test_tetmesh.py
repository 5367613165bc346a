"""The tet mesh: what it refuses, and its boundary."""

import logging
from itertools import combinations

import numpy as np
import pytest

from sdfnet.errors import GeometryError
from sdfnet.geometry.inspection import inspection
from sdfnet.geometry.solids import Sphere, kuhn_grid
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


def test_a_tet_that_is_there_twice_is_refused_however_it_is_numbered() -> None:
    mesh = Sphere(radius=0.3, cells=2).tet_mesh()
    again = mesh.tets[[3, 7]][:, [1, 2, 0, 3]]  # turned about a corner: the same tet, the same orientation
    with pytest.raises(GeometryError, match=rf"found 2 again, the first at index {len(mesh.tets)}, .* would count twice"):
        TetMesh(mesh.nodes, np.vstack([mesh.tets, again]))
    with pytest.raises(GeometryError, match="found 1 again, the first at index 1"):
        TetMesh(UNIT, np.vstack([ONE, ONE]))


def test_three_tets_on_one_face_are_refused() -> None:
    nodes = np.vstack([UNIT, [[0.2, 0.2, -1.0], [0.3, 0.3, -0.5]]])
    below = np.array([[0, 2, 1, 4], [0, 2, 1, 5]])
    assert len(TetMesh(nodes, np.vstack([ONE, below[:1]])).boundary_faces) == 6
    with pytest.raises(GeometryError, match=r"one tet or two, found 1 of more, the first about \(0\.3333, 0\.3333, 0\) m"):
        TetMesh(nodes, np.vstack([ONE, below]))


@pytest.mark.parametrize("number", [4, -1])
def test_a_node_that_does_not_exist_is_named(number: int) -> None:
    with pytest.raises(GeometryError, match=rf"four node numbers from 0 to 3, found numbers from {min(0, number)} to {max(2, number)}; count nodes"):
        TetMesh(UNIT, np.array([[0, 1, 2, number]]))


def test_the_boundary_is_closed_outward_and_encloses_the_tets() -> None:
    mesh = Sphere(radius=0.3, cells=4).tet_mesh()
    surface = mesh.surface()
    assert inspection(surface).problems() == []
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
    with pytest.raises(
        GeometryError,
        match=r"every tet must have positive volume, found 2 inverted or flat, the first at index 2, \(0\.25, 0\.75, 0\.5\) m; mesh the solid again, or swap",
    ):
        TetMesh(nodes, inverted)
    with pytest.raises(GeometryError, match=r"found 1 inverted or flat, the first at index 0, \(0\.25, 0\.25, 0\) m; mesh"):
        TetMesh(UNIT * [1, 1, 0], ONE)


@pytest.mark.parametrize("scale", [1e-3, 1.0])
def test_a_regular_tet_has_the_aspect_ratio_sqrt_three_halves(scale: float) -> None:
    regular = np.array([[1.0, 1, 1], [-1, -1, 1], [-1, 1, -1], [1, -1, -1]])
    mesh = TetMesh(scale * regular, ONE)
    assert mesh.aspect_ratios == pytest.approx([np.sqrt(1.5)], rel=1e-14)
    assert mesh.smallest_altitudes == pytest.approx([scale * np.sqrt(8) * np.sqrt(2 / 3)], rel=1e-14)


@pytest.mark.parametrize("corner", range(4))
def test_the_smallest_altitude_stands_on_the_largest_face(corner: int) -> None:
    base = np.array([[0.0, 0, 0], [3, 0, 0], [0, 3, 0]])
    nodes = np.insert(base, corner, [1.0, 1.0, 0.25], axis=0)  # low over the middle of its base
    oriented = ONE if np.linalg.det(nodes[1:] - nodes[0]) > 0 else ONE[:, [0, 2, 1, 3]]
    mesh = TetMesh(nodes, oriented)
    assert mesh.smallest_altitudes == pytest.approx([0.25], rel=1e-14)
    assert mesh.aspect_ratios == pytest.approx([np.sqrt(18) / 0.25], rel=1e-14)


def test_a_sliver_is_taken_and_named_as_the_worst() -> None:
    nodes, tets = kuhn_grid((1, 1, 1))
    base = tets[4, :3]  # the fifth tet is cut in four about a point just over its base
    apex = nodes[base].mean(axis=0) + 1e-4 * (nodes[tets[4, 3]] - nodes[base].mean(axis=0))
    a, b, c, d = tets[4]
    around = np.array([[a, b, c, 8], [a, b, 8, d], [b, c, 8, d], [c, a, 8, d]])
    mesh = TetMesh(np.vstack([nodes, apex]), np.vstack([np.delete(tets, 4, axis=0), around]))
    assert mesh.volumes.sum() == pytest.approx(1.0, rel=1e-14)
    worst = mesh.worst
    assert worst.index == 5
    assert worst.aspect_ratio > 1e4
    assert worst.aspect_ratio == mesh.aspect_ratios.max()
    height = 6 * mesh.volumes[5] / np.linalg.norm(np.cross(nodes[b] - nodes[a], nodes[c] - nodes[a]))
    assert worst.smallest_altitude == pytest.approx(height, rel=1e-12)
    np.testing.assert_allclose(worst.place, np.vstack([nodes[[a, b, c]], apex]).mean(axis=0), rtol=1e-14)


@pytest.mark.parametrize("scale", [1e-3, 1.0])
def test_two_nodes_at_one_place_are_warned_of_as_a_crack(scale: float, caplog: pytest.LogCaptureFixture) -> None:
    nodes, tets = kuhn_grid((2, 1, 1))
    cut = np.vstack([nodes, nodes[5] + [0.0, 0.0, 1e-10]])
    loose = tets.copy()
    tet, corner = np.argwhere(loose == 5)[0]
    loose[tet, corner] = len(nodes)
    with caplog.at_level(logging.WARNING):
        TetMesh(scale * nodes, tets)
        TetMesh(scale * np.vstack([nodes, nodes[:1]]), tets)  # the second node at that place belongs to no tet
        assert not caplog.messages
        TetMesh(scale * cut, loose)
    x, y, z = scale * nodes[5]
    (message,) = caplog.messages
    assert message.startswith(f"2 nodes of the tet mesh lie upon another, the first at index 5, ({x:.4g}, {y:.4g}, {z:.4g}) m; the solid is cracked there")


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
