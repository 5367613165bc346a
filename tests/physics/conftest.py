"""Small solids for the physics tests, and an effect written in a test as a user would write one."""

from collections.abc import Callable, Sequence

import numpy as np
import pytest
from skfem import MeshTet

from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.scene import Geometry

MakeBox = Callable[..., TetMesh]


@pytest.fixture(scope="session")
def make_box() -> MakeBox:
    """A function of three rising sequences of coordinates: their grid cut into tets, inner nodes moved at random by `jitter` times the spacing."""

    def make(x: Sequence[float], y: Sequence[float], z: Sequence[float], jitter: float = 0.0) -> TetMesh:
        grid = MeshTet.init_tensor(np.asarray(x, dtype=float), np.asarray(y, dtype=float), np.asarray(z, dtype=float))
        nodes, tets = grid.p.T.copy(), grid.t.T.astype(np.int64)
        corners = nodes[tets]
        inverted = np.linalg.det(corners[:, 1:] - corners[:, :1]) < 0
        tets[inverted] = tets[inverted][:, [0, 2, 1, 3]]
        mesh = TetMesh(nodes, tets)
        if jitter == 0:
            return mesh
        inner = np.setdiff1d(np.arange(len(nodes)), mesh.surface_nodes)
        moved = nodes.copy()
        moved[inner] += jitter * mesh.smallest_edge * np.random.default_rng(3).uniform(-1, 1, (len(inner), 3))
        return TetMesh(moved, tets)

    return make


@pytest.fixture
def no_geometry() -> Geometry:
    """What a scene says of its solid when the test hands the mesh over itself."""
    return Geometry()
