"""fTetWild behind its one function, on a small ball."""

import numpy as np
import pytest
import torch
import trimesh

from sdfnet.errors import GeometryError
from sdfnet.geometry.distance import signed_distance
from sdfnet.geometry.inspection import inspection
from sdfnet.geometry.surface import Surface
from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.geometry.tetrahedralise import neighbours_together, tetrahedralise

ENVELOPE = 1e-3


@pytest.fixture(scope="module")
def ball() -> Surface:
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=0.1)
    return Surface(np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64))


@pytest.fixture(scope="module")
def filled(ball: Surface) -> TetMesh:
    return tetrahedralise(ball, edge_length=0.2, envelope=ENVELOPE)


def test_the_tets_fill_the_surface(ball: Surface, filled: TetMesh) -> None:
    assert filled.volumes.min() > 0
    assert filled.volumes.sum() == pytest.approx(ball.as_trimesh().volume, rel=3 * ENVELOPE * ball.diagonal / 0.1)  # dV/V = 3 dr/r
    assert inspection(filled.surface()).problems() == []


def test_the_boundary_stays_inside_the_envelope(ball: Surface, filled: TetMesh) -> None:
    distances = signed_distance(torch.from_numpy(filled.surface().vertices).float(), ball).abs()
    assert float(distances.max()) <= ENVELOPE * ball.diagonal


def test_numbering_neighbours_together_changes_no_tet_and_shortens_the_band(filled: TetMesh) -> None:
    shuffle = np.random.default_rng(0).permutation(len(filled.nodes))
    shuffled = TetMesh(filled.nodes[shuffle], np.argsort(shuffle)[filled.tets])
    ordered = neighbours_together(shuffled)
    np.testing.assert_array_equal(ordered.nodes[ordered.tets], filled.nodes[filled.tets])
    assert np.ptp(ordered.tets, axis=1).mean() < 0.3 * np.ptp(shuffled.tets, axis=1).mean()


def test_what_ftetwild_fills_is_numbered_so(filled: TetMesh) -> None:
    assert np.ptp(filled.tets, axis=1).mean() < 0.2 * len(filled.nodes)  # 0.13; 0.36 as fTetWild numbers them


def test_a_shorter_edge_gives_more_tets() -> None:
    box = trimesh.creation.box()
    cube = Surface(np.asarray(box.vertices, dtype=np.float64), np.asarray(box.faces, dtype=np.int64))
    coarse, fine = (len(tetrahedralise(cube, edge_length=edge).tets) for edge in (0.2, 0.08))
    assert fine > 1.5 * coarse  # measured 2.3; fTetWild varies by 4 % from run to run


def test_a_surface_that_encloses_nothing_is_refused() -> None:
    flat = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    with pytest.raises(GeometryError, match="fTetWild left no tets"):
        tetrahedralise(Surface(flat, np.array([[0, 1, 2], [0, 2, 3]])), edge_length=0.5)


def test_no_faces_and_vertices_that_are_not_finite_are_refused_before_ftetwild_sees_them(ball: Surface) -> None:
    with pytest.raises(GeometryError, match="needs a surface with faces, found none"):
        tetrahedralise(Surface(ball.vertices, ball.faces[:0]))
    broken = ball.vertices.copy()
    broken[3, 1], broken[4] = np.nan, np.inf
    with pytest.raises(GeometryError, match="needs finite vertices, found 2 that are not"):
        tetrahedralise(Surface(broken, ball.faces))
