"""A run that goes on from a snapshot is the uninterrupted run, bit for bit."""

import copy
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import pytest
import torch
from jaxtyping import Bool, Float64

from sdfnet.errors import PhysicsError
from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.effects.arrays import NodalForce
from sdfnet.physics.effects.history import ramp
from sdfnet.physics.effects.inclusion import Inclusion
from sdfnet.physics.effects.initial_motion import InitialMotion
from sdfnet.physics.effects.pinned import Pinned
from sdfnet.physics.effects.pressure_poke import PressurePoke
from sdfnet.physics.effects.rayleigh_damping import RayleighDamping
from sdfnet.physics.integrators import INTEGRATORS
from sdfnet.physics.plan import Plan, plan
from sdfnet.physics.regions import Region
from sdfnet.physics.simulate import SimulationStopped, Snapshot, run
from sdfnet.scene import Effect, Geometry, Material, Recording, Scene, Solver

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


def first_snapshot(compiled: Plan) -> Snapshot:
    snapshots: list[Snapshot] = []
    run(compiled, keep=snapshots.append)
    return snapshots[0]


def test_the_same_scene_planned_again_has_the_same_fingerprint_and_any_other_another(cube: TetMesh) -> None:
    scene = scene_of(DAMPED)
    others = [
        replace(scene, material=Material(density=1.001)),
        replace(scene, recording=Recording(duration=0.02, frames=11)),
        replace(scene, solver=Solver("symplectic_euler")),
        replace(scene, effects={**DAMPED, "foot": Pinned(components=(True, True, False))}),
        replace(scene, effects={**DAMPED, "pull": NodalForce(np.eye(len(cube.nodes))[:, -3:])}),
        replace(scene, effects={**DAMPED, "pull": NodalForce(np.eye(len(cube.nodes))[:, -6:-3])}),
    ]
    moved = TetMesh(1.001 * cube.nodes, cube.tets)
    found = [plan(scene, cube), plan(scene, cube), plan(scene, moved), replace(plan(scene, cube), steps_per_frame=99), *(plan(other, cube) for other in others)]
    fingerprints = [compiled.fingerprint() for compiled in found]
    assert fingerprints[0] == fingerprints[1]
    assert len(set(fingerprints)) == len(found) - 1


def test_the_fingerprint_sees_a_mesh_that_changes_no_load(cube: TetMesh) -> None:
    scene = scene_of({"throw": InitialMotion(velocity=(0.1, 0.0, 0.0))})
    moved, turned = TetMesh(1.001 * cube.nodes, cube.tets), TetMesh(cube.nodes, cube.tets[::-1].copy())
    assert len({replace(plan(scene, mesh), steps_per_frame=99).fingerprint() for mesh in (cube, moved, turned)}) == 3


def test_a_snapshot_of_another_plan_is_refused(cube: TetMesh) -> None:
    other = first_snapshot(plan(scene_of({**PLAIN, "push": replace(PUSH, pressure=11.0)}), cube))
    compiled = plan(scene_of(PLAIN), cube)
    message = f"only go on from a snapshot of its own plan, {compiled.fingerprint()}, found one of plan {other.fingerprint}: scene, mesh or step differ; begin"
    with pytest.raises(PhysicsError, match=message):
        run(compiled, resume=other)


def test_the_fingerprint_sees_what_the_text_of_a_large_array_leaves_out(make_box: MakeBox) -> None:
    axis = np.linspace(0, 1, 8)
    mesh = make_box(axis, axis, axis)
    pulls = [NodalForce(np.where(np.arange(len(mesh.nodes))[:, None] == node, [1.0, 0.0, 0.0], 0.0)) for node in (256, 257)]
    assert repr(pulls[0]) == repr(pulls[1])
    first, second = (plan(scene_of({"foot": Pinned(), "pull": pull}), mesh).fingerprint() for pull in pulls)
    assert first != second


@dataclass(frozen=True)
class Where(Region):
    """As a user would write one: its text says where a function stands in memory, and nothing of what it does."""

    is_inside: Callable[[Float64[np.ndarray, "points 3"]], Bool[np.ndarray, " points"]]

    def contains(self, points: Float64[np.ndarray, "points 3"], tolerance: float = 0.0) -> Bool[np.ndarray, " points"]:
        return self.is_inside(points)


@pytest.mark.parametrize("effect", ["foot", "bone"])
def test_the_fingerprint_is_that_of_what_a_region_holds_and_not_of_where_it_stands_in_memory(cube: TetMesh, effect: str) -> None:
    def fingerprint_below(height: float) -> str:
        region = Where(lambda points: points[:, 2] < height)
        assert " at 0x" in repr(region)
        kept.append(region)  # so that no other stands in its place
        chosen: Effect = Pinned(region) if effect == "foot" else Inclusion(region, Material(youngs_modulus=1e4))
        return plan(scene_of({**PLAIN, effect: chosen}), cube).fingerprint()

    kept: list[Region] = []
    low, again, high = fingerprint_below(0.2), fingerprint_below(0.2), fingerprint_below(0.6)
    assert low == again
    assert low != high
