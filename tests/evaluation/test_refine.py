"""Newton steps of vertices: on the zero of the field, as fast as Newton converges, and never far."""

import numpy as np
import pytest
import trimesh
from torch import Tensor

from sdfnet.evaluation.refine import refined_surface
from sdfnet.geometry.surface import Surface

RADIUS = 0.8
LONGEST = 0.02  # m


def squared_ball(points: Tensor) -> Tensor:
    """Not a distance: its gradient is as long as the diameter where the point is."""
    return points.square().sum(dim=1) - RADIUS**2


def sphere_of(radius: float) -> Surface:
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=radius)
    return Surface(np.asarray(mesh.vertices, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64))


def radii(surface: Surface) -> np.ndarray:
    found: np.ndarray = np.linalg.norm(surface.vertices, axis=1)
    return found


@pytest.mark.parametrize("start", [0.79, 0.81])
def test_every_step_squares_the_error(start: float) -> None:
    error = abs(start - RADIUS)
    for steps in (1, 2):
        error = error**2 / (2 * RADIUS) * 1.1  # Newton on r^2 - R^2: the next error is e^2 / 2r, and r is within a tenth of R
        found = refined_surface(sphere_of(start), squared_ball, LONGEST, steps)
        assert np.abs(radii(found) - RADIUS).max() < error + 1e-7  # float32 rounds a coordinate of 0.8 by 6e-8


def test_a_step_is_never_longer_than_allowed_and_goes_towards_the_surface() -> None:
    for start, end in ((0.6, 0.6 + LONGEST), (1.0, 1.0 - LONGEST)):
        np.testing.assert_allclose(radii(refined_surface(sphere_of(start), squared_ball, LONGEST, 1)), end, rtol=1e-6)


def test_no_step_leaves_every_vertex_and_steps_leave_the_faces() -> None:
    marched = sphere_of(0.79)
    np.testing.assert_array_equal(refined_surface(marched, squared_ball, LONGEST, 0).vertices, marched.vertices)
    np.testing.assert_array_equal(refined_surface(marched, squared_ball, LONGEST, 2).faces, marched.faces)


def test_a_vertex_without_a_gradient_stays() -> None:
    flat = Surface(np.zeros((3, 3)), np.array([[0, 1, 2]]))
    np.testing.assert_array_equal(refined_surface(flat, squared_ball, LONGEST, 3).vertices, flat.vertices)
