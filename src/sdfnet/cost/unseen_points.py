"""Points that no network was trained at and KNN-1 has no samples of: where the error of an answer is measured."""

import torch
from jaxtyping import Float32
from torch import Tensor

from sdfnet.data.sampling import SamplingBox, near_surface_points
from sdfnet.physics.trajectory import Trajectory
from sdfnet.scene import Sampling

UNSEEN = 20_000  # the mean error is known to about 1 %
SEED = 2026  # another than anybody's sampling has by default


def unseen_near_points(trajectory: Trajectory, box: SamplingBox, count: int = UNSEEN) -> Float32[Tensor, "points 3"]:
    """Points (m) about the surfaces of random frames, as `sampling.near_surface_count` draws them, but drawn anew."""
    drawn = Sampling(near_surface_count=count, seed=SEED)
    spread = drawn.near_surface_spread * trajectory.mesh.diagonal
    return torch.from_numpy(near_surface_points(trajectory.surface_vertices, trajectory.mesh.surface_faces, box, spread, drawn))
