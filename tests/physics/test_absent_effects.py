"""What a scene does not ask for costs nothing and changes nothing."""

import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from torch.overrides import TorchFunctionMode

from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.effects.body_force import BodyForce
from sdfnet.physics.effects.history import History, ramp
from sdfnet.physics.effects.initial_motion import InitialMotion
from sdfnet.physics.effects.pinned import Pinned
from sdfnet.physics.effects.pressure_poke import PressurePoke
from sdfnet.physics.effects.rayleigh_damping import RayleighDamping
from sdfnet.physics.integrators import INTEGRATORS
from sdfnet.physics.motion import EquationOfMotion
from sdfnet.physics.plan import plan
from sdfnet.physics.simulate import run
from sdfnet.scene import Effect, Geometry, Recording, Scene, Solver

MakeBox = Callable[..., TetMesh]
PUSH = PressurePoke(center=(0.5, 0.5, 1.0), radius=0.3, pressure=10.0)
POKED: dict[str, Effect] = {"foot": Pinned(), "push": PUSH}
NOTHINGS: dict[str, Effect] = {
    "poke": replace(PUSH, pressure=0.0),
    "poke over time": replace(PUSH, pressure=0.0, history=ramp(0.01)),
    "poke never on": replace(PUSH, history=History((0.0, 1.0), (0.0, 0.0))),
    "weight": BodyForce(density=(0.0, 0.0, 0.0)),
    "damping": RayleighDamping(0.0, 0.0),
    "throw": InitialMotion(),
}


@pytest.fixture(scope="module")
def cube(make_box: MakeBox) -> TetMesh:
    axis = np.linspace(0, 1, 4)
    return make_box(axis, axis, axis, jitter=0.2)


def scene_of(effects: dict[str, Effect], **solver: Any) -> Scene:
    return Scene(Geometry(), effects, recording=Recording(duration=0.02, frames=6), solver=Solver(**solver))


class Operations(TorchFunctionMode):
    """Keeps the names of the torch operations that run under it; those that end in _ or are given `out` allocate nothing."""

    def __init__(self) -> None:
        super().__init__()
        self.names: list[str] = []

    def __torch_function__(self, function: Any, types: Any, args: Any = (), kwargs: Any = None) -> Any:
        self.names.append(function.__name__ + (" out" if "out" in (kwargs or {}) else ""))
        return function(*args, **(kwargs or {}))


@pytest.mark.parametrize("nothing", NOTHINGS)
def test_an_effect_of_zero_magnitude_gives_the_bits_of_its_absence(cube: TetMesh, nothing: str) -> None:
    without, beside = plan(scene_of(POKED), cube), plan(scene_of({**POKED, nothing: NOTHINGS[nothing]}), cube)
    assert beside.time_step == without.time_step
    np.testing.assert_array_equal(run(beside).displacements, run(without).displacements)


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_all_of_them_together_do_so_with_every_integrator(cube: TetMesh, integrator: str) -> None:
    without, beside = (plan(scene_of(effects, integrator=integrator), cube) for effects in (POKED, {**NOTHINGS, **POKED}))
    assert beside.time_step == without.time_step
    np.testing.assert_array_equal(run(beside).displacements, run(without).displacements)


def test_what_comes_to_nothing_is_not_in_the_equation_and_the_plan_says_so(cube: TetMesh) -> None:
    compiled = plan(scene_of({**POKED, **NOTHINGS}), cube)
    motion, demands = compiled.equation(), compiled.demands
    assert list(demands.loads) == ["push"]
    assert (motion.timed_loads, motion.laws, demands.case_loads) == ((), (), {})
    assert not motion.damping
    assert motion.is_conservative
    lines = [line for line in demands.lines if line.endswith("which is left out")]
    assert {line.split(":")[0] for line in lines} == set(NOTHINGS)


def test_a_plain_step_is_three_operations_none_of_which_allocates(cube: TetMesh) -> None:
    integrator, _ = plan(scene_of(POKED), cube).compile()
    state = integrator.initial_state()
    with Operations() as operations:
        integrator.advance(state, 10)
    steps = [name for name in operations.names if name in ("index_add_", "addmm_", "add_")]
    assert steps == 10 * ["index_add_", "addmm_", "add_"]
    with Operations() as longer:
        integrator.advance(state, 20)
    assert len(longer.names) - len(operations.names) == 10 * 3, "what else is done is done once, however many steps"
    assert (state.work, state.own) == ({}, {})


@pytest.mark.parametrize(
    ("name", "effect"),
    [("ramp", replace(PUSH, history=ramp(0.01))), ("mass damping", RayleighDamping(mass=1.0)), ("stiffness damping", RayleighDamping(stiffness=1e-5))],
)
def test_what_is_asked_for_takes_more_operations(cube: TetMesh, name: str, effect: Effect) -> None:
    integrator, _ = plan(scene_of({**POKED, name: effect}), cube).compile()
    state = integrator.initial_state()
    with Operations() as operations:
        integrator.advance(state, 1)
    assert len(operations.names) > 3


def test_a_thousand_plain_steps_leave_no_memory_behind(cube: TetMesh) -> None:
    integrator, _ = plan(scene_of(POKED), cube).compile()
    state = integrator.initial_state()
    integrator.advance(state, 10)
    tracemalloc.start()
    before, _ = tracemalloc.get_traced_memory()
    integrator.advance(state, 1000)
    after, _ = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert after - before < 1000 * 8  # less than a number a step


def counted(monkeypatch: pytest.MonkeyPatch, kind: type, name: str) -> list[str]:
    """Grows by the name at every call."""
    calls: list[str] = []
    original = getattr(kind, name)

    def call(*arguments: Any) -> Any:
        calls.append(name)
        return original(*arguments)

    monkeypatch.setattr(kind, name, call)
    return calls


def test_a_scene_without_force_laws_never_enters_their_code(cube: TetMesh, monkeypatch: pytest.MonkeyPatch, on_springs: Callable[..., Effect]) -> None:
    all_calls = [counted(monkeypatch, EquationOfMotion, name) for name in ("nodal", "on_free")]
    run(plan(scene_of({**POKED, "ramp": replace(PUSH, history=ramp(0.01)), "damping": RayleighDamping(1.0, 1e-5)}), cube))
    assert all_calls == [[], []]
    run(plan(scene_of({**POKED, "springs": on_springs()}), cube))
    assert all(all_calls)


def test_a_scene_whose_loads_are_constant_never_asks_for_their_history(cube: TetMesh, monkeypatch: pytest.MonkeyPatch) -> None:
    calls = [counted(monkeypatch, History, name) for name in ("factor", "mean", "means", "largest_miss")]
    run(plan(scene_of(POKED), cube))
    assert calls == [[], [], [], []]
    compiled = plan(scene_of({**POKED, "ramp": replace(PUSH, history=ramp(0.01))}), cube)
    run(compiled)
    assert len(calls[2]) == compiled.scene.recording.frames  # for the start and once a frame, not once a step


def test_methods_without_a_step_limit_compute_none(cube: TetMesh, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: object) -> None:
        raise AssertionError("a step limit was computed")

    monkeypatch.setattr("sdfnet.physics.plan.step_limits", refuse)
    for name, kind in INTEGRATORS.items():
        if kind.is_explicit:
            with pytest.raises(AssertionError, match="a step limit was computed"):
                plan(scene_of(POKED, integrator=name), cube)
        else:
            assert plan(scene_of(POKED, integrator=name), cube).limits is None
