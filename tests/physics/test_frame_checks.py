"""Broken frames are found and marked."""

import logging
from dataclasses import replace

import numpy as np
import pytest

from sdfnet.geometry.solids import Box
from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.frame_checks import frame_checks
from sdfnet.physics.trajectory import Trajectory


def bent(mesh: TetMesh, *displacements: np.ndarray) -> Trajectory:
    frames = np.stack([np.zeros_like(mesh.nodes), *displacements])
    return Trajectory(mesh, np.arange(len(frames), dtype=np.float64), frames, 1.0, {})


@pytest.fixture(scope="module")
def bar() -> TetMesh:
    return Box(size=(8.0, 1.0, 1.0), cells=(16, 2, 2)).tet_mesh()


def test_a_stretched_solid_is_whole(bar: TetMesh, caplog: pytest.LogCaptureFixture) -> None:
    checks = frame_checks(bent(bar, 0.5 * bar.nodes))
    assert checks.broken == []
    assert caplog.messages == []


def test_a_mirrored_solid_has_every_tet_inverted_and_no_face_crossing(bar: TetMesh) -> None:
    checks = frame_checks(bent(bar, bar.nodes * [-2.0, 0.0, 0.0]))
    assert checks.inverted_tets.tolist() == [0, len(bar.tets)]
    assert checks.crossing_faces.tolist() == [0, 0]


def test_a_bar_rolled_up_into_itself_crosses_without_inverting_a_tet(bar: TetMesh, caplog: pytest.LogCaptureFixture) -> None:
    angle = 2.5 * np.pi * bar.nodes[:, 0] / 8.0  # more than a full turn: the ends overlap
    radius = 3.0 - bar.nodes[:, 2]
    rolled = np.stack([radius * np.sin(angle), bar.nodes[:, 1] + 0.03 * bar.nodes[:, 0], 3.0 - radius * np.cos(angle)], axis=1)
    with caplog.at_level(logging.WARNING, logger="sdfnet.physics.frame_checks"):
        checks = frame_checks(bent(bar, rolled - bar.nodes))
    assert checks.inverted_tets.tolist() == [0, 0]
    assert checks.crossing_faces[1] > 0
    assert checks.broken == [1]
    assert f"1 of 2 frames are broken, the first is frame 1; the worst, frame 1, has 0 inverted tets and {checks.crossing_faces[1]} pairs" in caplog.text


def test_a_load_case_keeps_its_own_frames_of_the_checks(bar: TetMesh) -> None:
    trajectory = bent(bar, bar.nodes * [-2.0, 0.0, 0.0])
    trajectory = replace(trajectory, cases=("still", "mirrored"), checks=frame_checks(trajectory))
    found = [trajectory.case(name).checks for name in trajectory.cases]
    assert [checks.broken for checks in found if checks is not None] == [[], [0]]
