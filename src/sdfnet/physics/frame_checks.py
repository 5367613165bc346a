"""Which frames of a trajectory are whole: no tet turned inside out, no part of the surface through another."""

import logging

import numpy as np

from sdfnet.geometry.self_intersection import SelfIntersectionSearch
from sdfnet.physics.elasticity import displacement_gradients
from sdfnet.physics.trajectory import FrameChecks, Trajectory

logger = logging.getLogger(__name__)


def frame_checks(trajectory: Trajectory) -> FrameChecks:
    """Count inverted tets and crossing faces in every frame; warns when there are any."""
    vertices = trajectory.surface_vertices
    search = SelfIntersectionSearch(trajectory.surface(0))
    inverted, crossing = (np.zeros(len(trajectory.times), dtype=np.int64) for _ in range(2))
    for frame, gradient in enumerate(displacement_gradients(trajectory.mesh, trajectory.displacements)):
        inverted[frame] = (np.linalg.det(gradient + np.eye(3)) <= 0).sum()
        search.deform(vertices[frame])
        crossing[frame] = search.count()
    checks = FrameChecks(inverted, crossing)
    if checks.broken:
        logger.warning("%s: the sign of the distance is doubtful where they overlap", checks.sentence())
    return checks
