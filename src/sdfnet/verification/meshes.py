"""The solids of the reference cases: boxes cut into tets, graded and with inner nodes moved at random."""

import numpy as np
from jaxtyping import Float64

from sdfnet.geometry.solids import kuhn_grid
from sdfnet.geometry.tetmesh import TetMesh


def box(x: Float64[np.ndarray, " x"], y: Float64[np.ndarray, " y"], z: Float64[np.ndarray, " z"], jitter: float = 0.0) -> TetMesh:
    """The grid of three rising rows of coordinates (m) cut into tets, each inner node moved by up to `jitter` times the shortest edge."""
    axes = (x, y, z)
    grid, tets = kuhn_grid((len(x) - 1, len(y) - 1, len(z) - 1))
    index = np.rint(grid * [len(axis) - 1 for axis in axes]).astype(np.int64)
    mesh = TetMesh(np.stack([axis[index[:, k]] for k, axis in enumerate(axes)], axis=1), tets)
    if jitter == 0:
        return mesh
    inner = np.setdiff1d(np.arange(len(mesh.nodes)), mesh.surface_nodes)
    moved = mesh.nodes.copy()
    moved[inner] += jitter * mesh.smallest_edge * np.random.default_rng(3).uniform(-1, 1, (len(inner), 3))
    return TetMesh(moved, tets)


def jittered_box(scale: float = 1.0) -> TetMesh:
    """2 x 1 x 1.5 times `scale` (m), without any symmetry that could hide an error."""
    return box(scale * np.linspace(0, 2, 5), scale * np.linspace(0, 1, 4), scale * np.linspace(0, 1.5, 5), jitter=0.2)


def small_box() -> TetMesh:
    """Eight unequal cells of a box of some 2 m: 27 nodes, for tens of thousands of steps."""
    return box(np.array([0.0, 1.0, 2.0]), np.array([0.0, 1.0, 1.7]), np.array([0.0, 0.8, 2.0]))
