"""Many loads in one run, each as if it were alone."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

from sdfnet.errors import ConfigurationError, PhysicsError
from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.effects.body_force import BodyForce
from sdfnet.physics.effects.history import ramp
from sdfnet.physics.effects.pinned import Pinned
from sdfnet.physics.effects.pressure_poke import PressurePoke
from sdfnet.physics.effects.rayleigh_damping import RayleighDamping
from sdfnet.physics.integrators import INTEGRATORS
from sdfnet.physics.plan import plan
from sdfnet.physics.simulate import simulate
from sdfnet.scene import Effect, Geometry, Recording, Scene, Solver

MakeBox = Callable[..., TetMesh]
WEIGHT = BodyForce(density=(0.0, 0.0, -3.0))
POKE = PressurePoke(center=(0.5, 0.5, 1.0), radius=0.3, pressure=10.0)
POKES: dict[str, Effect] = {"top": POKE, "side": replace(POKE, center=(1.0, 0.5, 0.6)), "pull": replace(POKE, center=(0.4, 0.0, 0.7), pressure=-20.0)}
SCENE = Scene(Geometry(), {"foot": Pinned(), "weight": WEIGHT}, recording=Recording(duration=0.02, frames=4), load_cases=POKES)
ALONE = {"cpu": 1e-14, "cuda": 1e-12}  # relative: sums of the same products in another order; those of CUDA beside single runs on the CPU


@pytest.fixture(scope="module")
def cube(make_box: MakeBox) -> TetMesh:
    axis = np.linspace(0, 1, 4)
    return make_box(axis, axis, axis, jitter=0.2)


def require_each_as_alone(scene: Scene, mesh: TetMesh, device: str = "cpu") -> None:
    together = simulate(scene, mesh, device=device)
    assert together.cases == tuple(scene.load_cases)
    for name, effect in scene.load_cases.items():
        alone = simulate(replace(scene, effects=scene.effects | {name: effect}, load_cases={}), mesh)
        found = together.case(name)
        np.testing.assert_array_equal(found.times, alone.times)
        assert found.time_step == alone.time_step
        np.testing.assert_allclose(found.displacements, alone.displacements, rtol=0, atol=ALONE[device] * np.abs(alone.displacements).max())
        assert np.abs(alone.displacements).max() > 0


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_pokes_in_one_run_are_as_many_runs_of_one_poke(cube: TetMesh, integrator: str) -> None:
    require_each_as_alone(replace(SCENE, solver=Solver(integrator, modes=200)), cube)


@pytest.mark.parametrize("solver", [Solver(mass="consistent"), Solver(element="P2"), Solver("symplectic_euler", element="P1_nodal_pressure")])
def test_the_same_holds_for_every_mass_and_element(make_box: MakeBox, solver: Solver) -> None:
    require_each_as_alone(replace(SCENE, solver=solver), make_box([0, 0.5, 1], [0, 1], [0, 0.5, 1]))


@pytest.mark.parametrize("integrator", ["leapfrog", "newmark"])
def test_cases_may_change_with_time_each_in_its_way_and_be_damped(cube: TetMesh, integrator: str) -> None:
    cases: dict[str, Effect] = {"first": replace(POKE, history=ramp(0.01)), "second": replace(POKE, history=ramp(0.015)), "constant": POKES["side"]}
    effects: dict[str, Effect] = {**SCENE.effects, "damping": RayleighDamping(5.0, 1e-4)}
    require_each_as_alone(replace(SCENE, effects=effects, load_cases=cases, solver=Solver(integrator, time_step=5e-4)), cube)


def test_a_case_that_pushes_with_nothing_is_a_case_still(cube: TetMesh) -> None:
    cases: dict[str, Effect] = {"nothing": replace(POKE, pressure=0.0), "top": POKE}
    trajectory = simulate(replace(SCENE, effects={"foot": Pinned()}, load_cases=cases), cube)
    assert not trajectory.case("nothing").displacements.any()
    assert trajectory.case("top").displacements.any()


def test_the_frames_of_the_cases_follow_one_another(cube: TetMesh) -> None:
    trajectory = simulate(SCENE, cube)
    assert len(trajectory.times) == len(trajectory.displacements) == SCENE.frame_count == 12
    np.testing.assert_array_equal(trajectory.times, np.tile(trajectory.times[:4], 3))
    np.testing.assert_array_equal(trajectory.displacements, np.concatenate([trajectory.case(name).displacements for name in POKES]))
    assert trajectory.case("side").cases == ()
    assert {f"{name}_resultant_N" for name in POKES} <= set(trajectory.report)
    with pytest.raises(ConfigurationError, match="no load case 'left'; known are top, side, pull"):
        trajectory.case("left")


def test_the_plan_lists_the_cases_and_expects_the_stress_of_the_strongest(cube: TetMesh) -> None:
    compiled = plan(SCENE, cube)
    text = compiled.describe().splitlines()
    first = text.index("3 load cases in one run, a column each") + 1
    assert [line.split(" (")[0] for line in text[first : first + 4]] == [
        "  top: PressurePoke adds a constant load",
        "  side: PressurePoke adds a constant load",
        "  pull: PressurePoke adds a constant load",
        "matrices",
    ]
    assert compiled.demands.stress == pytest.approx(20.0 + 3.0 * cube.diagonal)
    assert compiled.equation().constant_force.shape[1] == 3


@pytest.mark.parametrize(
    ("cases", "message"),
    [
        ({"foot two": Pinned()}, "load case 'foot two' must be an effect that adds a load, found Pinned; put it among scene.effects"),
        ({"weight": POKE}, "load case 'weight' has the name of an effect, and what the two report would be mixed up; rename one"),
        ({"low": replace(POKE, center=(0.5, 0.5, 0.0), radius=0.1)}, "the load 'low' must reach a node that is free to move"),
    ],
)
def test_what_is_no_case_is_refused(cube: TetMesh, cases: dict[str, Effect], message: str) -> None:
    with pytest.raises((ConfigurationError, PhysicsError), match=message):
        plan(replace(SCENE, load_cases=cases), cube)


def test_cases_beside_a_force_that_follows_the_state_are_refused(cube: TetMesh, on_springs: type[Effect]) -> None:
    with pytest.raises(ConfigurationError, match="load cases in one run need a linear scene, found 'springs'; simulate the cases one by one"):
        plan(replace(SCENE, effects={**SCENE.effects, "springs": on_springs()}), cube)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
@pytest.mark.parametrize("integrator", ["leapfrog", "symplectic_euler"])
@pytest.mark.parametrize("more", [{}, {"damping": RayleighDamping(5.0, 1e-4), "push": replace(POKE, center=(0.5, 1.0, 0.5), history=ramp(0.01))}])
def test_pokes_in_one_run_on_cuda_are_as_many_runs_of_one_poke(cube: TetMesh, integrator: str, more: dict[str, Effect]) -> None:
    require_each_as_alone(replace(SCENE, effects={**SCENE.effects, **more}, solver=Solver(integrator)), cube, device="cuda")
