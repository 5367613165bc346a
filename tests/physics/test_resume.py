"""A run that goes on from a snapshot is the uninterrupted run, bit for bit."""

import copy
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.effects.history import ramp
from sdfnet.physics.effects.initial_motion import InitialMotion
from sdfnet.physics.effects.pinned import Pinned
from sdfnet.physics.effects.pressure_poke import PressurePoke
from sdfnet.physics.effects.rayleigh_damping import RayleighDamping
from sdfnet.physics.integrators import INTEGRATORS
from sdfnet.physics.plan import Plan, plan
from sdfnet.physics.simulate import SimulationStopped, Snapshot, run
from sdfnet.scene import Effect, Geometry, Recording, Scene, Solver

MakeBox = Callable[..., TetMesh]
PUSH = PressurePoke(center=(0.5, 0.5, 1.0), radius=0.3, pressure=10.0)
PLAIN: dict[str, Effect] = {"foot": Pinned(), "push": PUSH}
RAMPED: dict[str, Effect] = {"foot": Pinned(), "push": replace(PUSH, history=ramp(0.015)), "weight": replace(PUSH, center=(0.0, 0.5, 0.5))}
DAMPED: dict[str, Effect] = {**RAMPED, "damping": RayleighDamping(10.0, 1e-4), "throw": InitialMotion(velocity=(0.1, 0.0, 0.0))}
CASES: dict[str, Effect] = {"left": replace(PUSH, center=(0.0, 0.5, 0.6)), "right": replace(PUSH, center=(1.0, 0.5, 0.6), history=ramp(0.01))}


@pytest.fixture(scope="module")
def cube(make_box: MakeBox) -> TetMesh:
    axis = np.linspace(0, 1, 4)
    return make_box(axis, axis, axis, jitter=0.2)


def scene_of(effects: dict[str, Effect], **solver: object) -> Scene:
    return Scene(Geometry(), effects, recording=Recording(duration=0.02, frames=6), solver=Solver(**solver))  # type: ignore[arg-type]


def require_the_same_from_every_frame(compiled: Plan) -> None:
    snapshots: list[Snapshot] = []
    whole = run(compiled, keep=snapshots.append)
    assert [snapshot.displacements.shape[1] for snapshot in snapshots] == [2, 3, 4, 5, 6]
    for snapshot in snapshots:
        resumed = run(compiled, resume=snapshot)
        np.testing.assert_array_equal(resumed.displacements, whole.displacements)
        assert {name: value for name, value in resumed.report.items() if name != "step_seconds"} == {
            name: value for name, value in whole.report.items() if name != "step_seconds"
        }


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("effects", [PLAIN, RAMPED])
def test_every_integrator_goes_on_from_every_frame(cube: TetMesh, integrator: str, effects: dict[str, Effect]) -> None:
    require_the_same_from_every_frame(plan(scene_of(effects, integrator=integrator), cube))


@pytest.mark.parametrize("integrator", [name for name, kind in INTEGRATORS.items() if "damping" not in kind.refuses])
def test_damping_and_an_initial_motion_do_not_matter(cube: TetMesh, integrator: str) -> None:
    require_the_same_from_every_frame(plan(scene_of(DAMPED, integrator=integrator), cube))


@pytest.mark.parametrize("integrator", ["leapfrog", "symplectic_euler"])
@pytest.mark.parametrize("speed", [0.0, 0.3])
def test_forces_that_follow_the_state_do_not_matter(cube: TetMesh, on_springs: Callable[..., Effect], integrator: str, speed: float) -> None:
    effects = {**DAMPED, "springs": on_springs(share=0.05, speed=speed)}
    require_the_same_from_every_frame(plan(scene_of(effects, integrator=integrator), cube))


@pytest.mark.parametrize("solver", [{"mass": "consistent"}, {"element": "P2"}, {"integrator": "newmark", "element": "P1_nodal_pressure"}])
def test_neither_do_mass_element_and_load_cases(cube: TetMesh, solver: dict[str, str]) -> None:
    require_the_same_from_every_frame(plan(replace(scene_of({"foot": Pinned()}, **solver), load_cases=CASES), cube))


def test_a_snapshot_stays_as_it_was_taken(cube: TetMesh) -> None:
    compiled = plan(scene_of(DAMPED, integrator="newmark"), cube)
    snapshots: list[Snapshot] = []
    copies: list[Snapshot] = []

    def keep(snapshot: Snapshot) -> None:
        snapshots.append(snapshot)
        copies.append(copy.deepcopy(snapshot))

    run(compiled, keep=keep)
    run(compiled, resume=snapshots[0])
    for found, expected in zip(snapshots, copies, strict=True):
        np.testing.assert_array_equal(found.displacements, expected.displacements)
        assert found.state.step == expected.state.step
        for one, other in ((found.state.displacement, expected.state.displacement), (found.state.velocity, expected.state.velocity)):
            assert torch.equal(one, other)
        assert torch.equal(found.state.own["acceleration"], expected.state.own["acceleration"])
        assert torch.equal(found.state.work["loads"], expected.state.work["loads"])


def test_progress_goes_on_where_it_stopped(cube: TetMesh) -> None:
    compiled = plan(scene_of(PLAIN), cube)
    snapshots: list[Snapshot] = []
    run(compiled, keep=snapshots.append)
    seen: list[tuple[int, int]] = []
    run(compiled, lambda done, total: seen.append((done, total)), resume=snapshots[2])
    assert seen == [(4, 5), (5, 5)]


def test_the_watch_of_a_resumed_run_still_knows_the_energy_at_the_beginning(cube: TetMesh) -> None:
    compiled = plan(scene_of(PLAIN), cube)
    snapshots: list[Snapshot] = []
    run(compiled, keep=snapshots.append)
    snapshots[1].state.velocity.mul_(1 + 1e-5)
    with pytest.raises(SimulationStopped, match="simulation stopped at step .* found a drift of .*the last good frame is 2"):
        run(compiled, resume=snapshots[1])
