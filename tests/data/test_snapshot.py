"""A simulation that was killed goes on bit for bit from what it left on disk."""

import logging
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from sdfnet.data.snapshot import read_snapshot, run_resumably, write_snapshot
from sdfnet.geometry.solids import Sphere
from sdfnet.physics.effects.history import ramp
from sdfnet.physics.effects.pressure_poke import PressurePoke
from sdfnet.physics.plan import Plan, plan
from sdfnet.physics.simulate import Snapshot, run
from sdfnet.scene import Recording, Scene, Solver

PATH = Path("snapshot")


class Killed(Exception):
    """What a kill looks like from inside."""


def compiled(integrator: str = "leapfrog", pressure: float = 500.0) -> Plan:
    poke = PressurePoke(center=(-0.05, 0.0, 0.0), radius=0.03, pressure=pressure, history=ramp(1e-4))
    scene = Scene(Sphere(cells=3), {"poke": poke}, recording=Recording(duration=2e-4, frames=6), solver=Solver(integrator=integrator))
    return plan(scene, Sphere(cells=3).tet_mesh())


def kill_after(frame: int) -> None:
    def progress(done: int, total: int) -> None:
        if done == frame + 1:
            raise Killed

    with pytest.raises(Killed):
        run_resumably(compiled(), PATH, progress, seconds_between=0.0)


@pytest.mark.parametrize("frame", [1, 4])
def test_a_killed_run_ends_as_an_uninterrupted_one(frame: int, caplog: pytest.LogCaptureFixture) -> None:
    kill_after(frame)
    done: list[int] = []
    with caplog.at_level(logging.INFO, logger="sdfnet.data.snapshot"):
        resumed = run_resumably(compiled(), PATH, lambda now, total: done.append(now))
    assert done[0] == frame + 1
    assert f"goes on from frame {frame}" in caplog.text
    whole = run(compiled())
    np.testing.assert_array_equal(resumed.displacements, whole.displacements)
    assert resumed.report | {"step_seconds": 0.0} == whole.report | {"step_seconds": 0.0}  # the worst drift of the frames before the kill too
    assert not PATH.exists()


def test_a_short_run_writes_no_snapshot() -> None:
    def no_file(done: int, total: int) -> None:
        assert not PATH.exists()

    run_resumably(compiled(), PATH, no_file)


def test_snapshots_are_so_many_seconds_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    clock, frames = [0.0], []
    monkeypatch.setattr("sdfnet.data.snapshot.time", SimpleNamespace(monotonic=lambda: clock[0]))
    monkeypatch.setattr("sdfnet.data.snapshot.write_snapshot", lambda path, snapshot: frames.append(snapshot.displacements.shape[1] - 1))

    def ten_seconds_a_frame(done: int, total: int) -> None:
        clock[0] = 10.0 * done

    run_resumably(compiled(), PATH, ten_seconds_a_frame, seconds_between=20.0)
    assert frames == [2, 4]


def test_a_broken_snapshot_is_passed_over_with_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    kill_after(2)
    PATH.write_bytes(PATH.read_bytes()[:1000])
    with caplog.at_level(logging.WARNING, logger="sdfnet.data.snapshot"):
        trajectory = run_resumably(compiled(), PATH)
    assert "truncated" in caplog.text
    assert "begins anew" in caplog.text
    np.testing.assert_array_equal(trajectory.displacements, run(compiled()).displacements)


def test_a_snapshot_of_another_plan_is_passed_over_with_a_warning(caplog: pytest.LogCaptureFixture) -> None:
    kill_after(2)
    with caplog.at_level(logging.WARNING, logger="sdfnet.data.snapshot"):
        trajectory = run_resumably(compiled(pressure=400.0), PATH)
    assert "must be a snapshot of this plan, found one of another scene, mesh or step; the simulation begins anew" in caplog.text
    np.testing.assert_array_equal(trajectory.displacements, run(compiled(pressure=400.0)).displacements)


def test_a_method_that_carries_more_than_displacement_and_velocity_goes_on_too() -> None:
    def keep(snapshot: Snapshot) -> None:
        if not PATH.exists():
            write_snapshot(PATH, snapshot)

    whole = run(compiled("newmark"), keep=keep)
    np.testing.assert_array_equal(run(compiled("newmark"), resume=read_snapshot(PATH)).displacements, whole.displacements)
