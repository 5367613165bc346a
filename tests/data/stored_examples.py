"""A small example of each file that sdfnet stores, and where the tests put it."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from sdfnet.data import store
from sdfnet.data.sampling import SamplingBox
from sdfnet.data.store import DistanceSamples
from sdfnet.geometry.solids import Sphere
from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.trajectory import Trajectory

PROVENANCE = {"scene": {"kind": "Scene"}, "seconds": 1.5}
TRAJECTORY, SAMPLES, MESH = Path("trajectory.h5"), Path("distances.h5"), Path("mesh.vtu")


def small_mesh() -> TetMesh:
    return Sphere(radius=0.05, cells=3).tet_mesh()


def small_trajectory() -> Trajectory:
    mesh = small_mesh()
    displacements = np.random.default_rng(0).normal(0, 1e-3, (4, len(mesh.nodes), 3))
    return Trajectory(mesh, np.array([0.0, 0.1, 0.2, 1 / 3]), displacements, 1e-6 / 3, {"steps": 7, "energy_drift": 1e-13, "mass": "lumped"})


def small_samples() -> DistanceSamples:
    generator = np.random.default_rng(1)

    def random(*shape: int) -> np.ndarray:
        return generator.normal(size=shape).astype(np.float32)

    box = SamplingBox(np.array([0.1, 0.2, 0.3]), np.array([1.1, 1.2, 1.3]))
    kept = np.sort(generator.integers(0, 50, (4, 20)).astype(np.int32), axis=1)
    return DistanceSamples(box, random(50, 3), random(4, 50), kept, random(10, 3), random(4, 10))


def write_all() -> None:
    store.write_trajectory(TRAJECTORY, small_trajectory(), PROVENANCE)
    store.write_distances(SAMPLES, small_samples(), PROVENANCE)
    store.write_mesh(MESH, small_mesh(), PROVENANCE)


READERS: list[tuple[Path, Callable[[Path], Any]]] = [
    (TRAJECTORY, store.read_trajectory),
    (SAMPLES, store.read_distances),
    (MESH, store.read_mesh),
]
