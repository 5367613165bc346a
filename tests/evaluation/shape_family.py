"""A small family of shapes with its samples, made without a simulation."""

import numpy as np

from sdfnet.data.prepare import sample_distances
from sdfnet.data.store import DistanceSamples
from sdfnet.geometry.solids import Sphere
from sdfnet.physics.trajectory import Trajectory
from sdfnet.scene import Sampling


def ball_trajectory(frames: int, is_straight: bool = False) -> Trajectory:
    """A ball of 5 cm that is squeezed, bent and stretched by some millimetres; if straight, every node moves evenly along a line."""
    mesh = Sphere(radius=0.05, cells=5).tet_mesh()
    x, y, z = mesh.nodes.T
    zero = np.zeros_like(x)
    fields = np.stack([np.stack([x, -y / 2, zero], axis=1), np.stack([zero, zero, 20 * x**2], axis=1), np.stack([z, zero, -x], axis=1)])
    share = np.linspace(0, 1, frames)
    bent = np.stack([np.sin(3 * share), share**2, np.cos(5 * share) - 1], axis=1)
    amounts = np.stack([share, share, share], axis=1) if is_straight else bent
    return Trajectory(mesh, share, 0.1 * np.einsum("fk,kni->fni", amounts, fields), 1.0, {})


def samples_of(trajectory: Trajectory) -> DistanceSamples:
    """Its distances, few but enough."""
    return sample_distances(trajectory, Sampling(count=5_000, near_surface_count=2_000))
