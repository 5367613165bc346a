"""Which frames of a trajectory are whole: no tet turned inside out, no part of the surface through another."""

import logging

import numpy as np

from sdfnet.geometry.self_intersection import SelfIntersectionSearch
from sdfnet.physics.trajectory import FrameChecks, Trajectory

logger = logging.getLogger(__name__)


def frame_checks(trajectory: Trajectory) -> FrameChecks:
    """Count inverted tets and crossing faces in every frame; warns when there are any."""
    vertices = trajectory.surface_vertices
    search = SelfIntersectionSearch(trajectory.surface(0))
    crossing = np.zeros(len(vertices), dtype=np.int64)
    for frame, moved in enumerate(vertices):
        search.deform(moved)
        crossing[frame] = search.count()
    checks = FrameChecks(trajectory.inverted_tets, crossing)
    if checks.broken:
        logger.warning("%s: the sign of the distance is doubtful where they overlap", checks.sentence())
    return checks
