"""Deforming shapes kept as meshes: exact where they must be, better with more bytes, and as large as they say."""

import numpy as np
import pytest
import torch

from sdfnet.cost.shape_baselines import DeformedMesh, KeptFrames, Motion, PodMotion
from sdfnet.errors import ConfigurationError
from sdfnet.evaluation.metrics import surface_errors
from sdfnet.geometry.distance import signed_distance
from sdfnet.physics.trajectory import Trajectory
from tests.evaluation.shape_family import ball_trajectory

FRAMES = 9
ROUNDING_MM = 2e-5  # three float32 steps at 5 cm: positions, modes and the search tree are each rounded


@pytest.fixture(scope="module")
def trajectory() -> Trajectory:
    """A ball with three kinds of movement."""
    return ball_trajectory(FRAMES)


def worst_chamfer(motion: Motion, trajectory: Trajectory) -> float:
    model = DeformedMesh(motion, trajectory.mesh.surface_faces)
    return max(
        surface_errors(model.surface(frame), trajectory.surface(frame), trajectory.mesh.diagonal, samples=2_000).chamfer_l1_mm
        for frame in range(len(trajectory.times))
    )


def test_pod_with_all_modes_is_exact_and_error_falls_with_each_mode(trajectory: Trajectory) -> None:
    vertices = trajectory.surface_vertices
    errors = [worst_chamfer(PodMotion.of(vertices, modes), trajectory) for modes in (1, 2, 3)]
    assert errors[0] > 2 * errors[1] > 4 * errors[2], "three fields move the ball: each mode takes one away"
    assert errors[2] < ROUNDING_MM
    assert worst_chamfer(PodMotion.of(vertices, FRAMES), trajectory) < ROUNDING_MM


def test_no_other_basis_of_as_many_modes_leaves_less(trajectory: Trajectory) -> None:
    vertices = trajectory.surface_vertices
    values = np.linalg.svd((vertices - vertices.mean(axis=0)).reshape(FRAMES, -1), compute_uv=False)
    motion = PodMotion.of(vertices, 2)
    left = sum(np.square(motion.vertices(frame) - vertices[frame]).sum() for frame in range(FRAMES))
    assert left == pytest.approx(np.square(values[2:]).sum(), rel=1e-3)  # Eckart and Young; float32 modes


def test_interpolation_is_exact_in_the_frames_it_keeps(trajectory: Trajectory) -> None:
    vertices = trajectory.surface_vertices
    assert worst_chamfer(KeptFrames.of(vertices, 1), trajectory) < ROUNDING_MM
    kept = KeptFrames.of(vertices, 3)
    np.testing.assert_array_equal(kept.frames, [0, 3, 6, 8])
    for frame in kept.frames:
        np.testing.assert_allclose(kept.vertices(int(frame)), vertices[frame], atol=1e-8)
    assert worst_chamfer(KeptFrames.of(vertices, 8), trajectory) > 2 * worst_chamfer(KeptFrames.of(vertices, 2), trajectory) > 0.01


@pytest.mark.parametrize("stride", [2, 5, 100])
def test_load_cases_that_follow_one_another_are_never_mixed(trajectory: Trajectory, stride: int) -> None:
    vertices = trajectory.surface_vertices
    moved = vertices + 1.0
    both = KeptFrames.of(np.concatenate([vertices, moved]), stride, cases=2)
    for case, own in enumerate((vertices, moved)):
        alone = KeptFrames.of(own, stride)
        for frame in range(FRAMES):
            np.testing.assert_array_equal(both.vertices(case * FRAMES + frame), alone.vertices(frame))


@pytest.mark.parametrize("stride", [2, 3, 5, 100])
def test_even_motion_along_lines_is_exact_at_any_stride(stride: int) -> None:
    trajectory = ball_trajectory(FRAMES, is_straight=True)
    assert worst_chamfer(KeptFrames.of(trajectory.surface_vertices, stride), trajectory) < ROUNDING_MM


def test_distances_follow_the_frame_that_is_asked_for(trajectory: Trajectory) -> None:
    model = DeformedMesh(PodMotion.of(trajectory.surface_vertices, FRAMES), trajectory.mesh.surface_faces)
    points = torch.rand(200, 3) * 0.1 - 0.05
    for frame in (8, 0, 4, 4):
        exact = signed_distance(points, trajectory.surface(frame))
        torch.testing.assert_close(model.distances(frame, points), exact, rtol=0, atol=1e-3 * ROUNDING_MM)


def test_bytes_are_those_of_the_arrays(trajectory: Trajectory) -> None:
    vertices, faces = trajectory.surface_vertices, trajectory.mesh.surface_faces
    shape = 3 * vertices.shape[1] * 4
    assert DeformedMesh(PodMotion.of(vertices, 2), faces).bytes == 3 * shape + FRAMES * 2 * 4 + faces.size * 1  # 98 vertices fit in a byte
    assert DeformedMesh(KeptFrames.of(vertices, 4), faces).bytes == 3 * shape + faces.size
    assert DeformedMesh(KeptFrames.of(vertices, 4), faces + 300).bytes == 3 * shape + 2 * faces.size


def test_impossible_sizes_are_refused(trajectory: Trajectory) -> None:
    with pytest.raises(ConfigurationError, match="between 1 and the 9 frames, found 10"):
        PodMotion.of(trajectory.surface_vertices, 10)
    with pytest.raises(ConfigurationError, match="at least 1, found 0"):
        KeptFrames.of(trajectory.surface_vertices, 0)
