"""What every integrator of the registry promises, against the matrix exponential of the whole equation of motion."""

import re
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm

from sdfnet.errors import ConfigurationError
from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.effects.history import History
from sdfnet.physics.effects.roles import Damping, ForceLaw
from sdfnet.physics.elasticity import ElasticModel, assemble
from sdfnet.physics.integrators import INTEGRATORS, Integrator
from sdfnet.physics.motion import EquationOfMotion
from sdfnet.scene import SOLVER_CHOICES, Material

MakeBox = Callable[..., TetMesh]
MakeSprings = Callable[..., ForceLaw]
MakeEquation = Callable[..., EquationOfMotion]
DURATION = 0.08  # s, 0.4 of a period of the slowest mode
STEPS = (160, 320, 640)  # the first is 0.17 of the stability limit with lumped mass, 0.32 with consistent mass
LARGE_STEPS = (8, 40)  # for what is exact at any step
RISING = History((0.0, DURATION / 2), (0.5, 1.0))  # from half the load: a load that begins at nothing would hide how a method starts
JUMPING = History(  # it jumps, sinks and stops within steps, at the same place within them however many there are
    (DURATION / 3, 1.0001 * DURATION / 3, 2 * DURATION / 3, 2.001 * DURATION / 3), (0.2, 1.0, -0.5, 0.6)
)
ORDERS = {"leapfrog": 2, "symplectic_euler": 1, "newmark": 2, "modal": None, "exact": None}  # None: exact in time
EXACT = 1e-12  # relative; rounding came to 1e-13


@dataclass(frozen=True)
class Case:
    """What acts on the solid beside a constant load, and which of an integrator's refusals that would be."""

    needs: str = ""
    settings: dict[str, Any] = field(default_factory=dict)
    is_held: bool = True
    is_moving: bool = False


CASES = {
    "constant load": Case(),
    "initial motion": Case(is_moving=True),
    "ramped load": Case("loads that change with time", {"history": RISING}),
    "load that jumps within a step": Case("loads that change with time", {"history": JUMPING}),
    "damped motion under a load that jumps": Case("damping", {"damping": Damping(mass=20.0, stiffness=2e-4), "history": JUMPING}, is_moving=True),
    "consistent mass under a load that jumps": Case("a consistent mass", {"kind": "consistent", "history": JUMPING}),
    "damping": Case("damping", {"damping": Damping(mass=20.0, stiffness=2e-4)}),
    "damped motion under a ramp": Case("damping", {"damping": Damping(mass=20.0, stiffness=2e-4), "history": RISING}, is_moving=True),
    "consistent mass": Case("a consistent mass", {"kind": "consistent"}),
    "free solid": Case(is_held=False, is_moving=True),
}
SERVED = [(name, case) for name, kind in INTEGRATORS.items() for case, what in CASES.items() if what.needs not in kind.refuses]


@pytest.fixture(scope="module")
def model(make_box: MakeBox) -> ElasticModel:
    return assemble(make_box([0, 0.5, 1], [0, 0.6, 1], [0, 0.5, 1, 1.5], jitter=0.2), Material())


@pytest.fixture(scope="module")
def equation(model: ElasticModel, make_equation: MakeEquation) -> Callable[..., EquationOfMotion]:
    """The equation of a case; the load is smooth, so that slow modes carry the motion, and each column is another one."""

    def make(case: str, columns: int = 1) -> EquationOfMotion:
        what, nodes = CASES[case], model.elements.nodes
        fixed = np.repeat(nodes[:, 2:] == 0, 3, axis=1) & what.is_held
        free = np.flatnonzero(~fixed.ravel())
        waves = np.stack([np.cos(nodes @ np.random.default_rng(column).uniform(-1, 1, (3, 3))) for column in range(columns)], axis=-1)
        field = waves.reshape(-1, columns)[free]
        start = {"displacement": 1e-3 * field, "velocity": 0.2 * field[::-1]} if what.is_moving else {}
        return make_equation(model, fixed, 50.0 * np.repeat(model.lumped_mass, 3)[free, None] * field, **what.settings, **start)

    return make


def built(name: str, motion: EquationOfMotion, time_step: float) -> Integrator:
    return INTEGRATORS[name](motion, time_step, **({"count": len(motion.free)} if name == "modal" else {}))


def after(name: str, motion: EquationOfMotion, steps: int) -> np.ndarray:
    integrator = built(name, motion, DURATION / steps)
    state = integrator.initial_state()
    integrator.advance(state, steps)
    assert state.step == steps
    return state.displacement.numpy()


def exact(motion: EquationOfMotion) -> np.ndarray:
    """The displacement at DURATION of the first column: exponentials of u, v, the load's factor and its slope."""
    size, inverse = len(motion.free), np.linalg.inv(motion.mass.matrix().toarray())
    damping = motion.damping.mass * np.eye(size) + motion.damping.stiffness * inverse @ motion.stiffness.toarray()
    history, force = (motion.timed_loads[0].history, motion.timed_loads[0].force) if motion.timed_loads else (History(), motion.constant_force)
    generator = np.zeros((2 * size + 2, 2 * size + 2))
    generator[:size, size:-2] = np.eye(size)
    generator[size:-2, :size], generator[size:-2, size:-2] = -inverse @ motion.stiffness.toarray(), -damping
    generator[size:-2, -2], generator[-2, -1] = inverse @ force[:, 0], 1.0
    state = np.concatenate([motion.displacement[:, 0], motion.velocity[:, 0], [0.0, 0.0]])
    ends = [0.0, *(time for time in history.times if 0 < time < DURATION), DURATION]
    for begin, end in zip(ends, ends[1:], strict=False):
        state[-2:] = history.factor(begin), (history.factor(end) - history.factor(begin)) / (end - begin)
        state = expm((end - begin) * generator) @ state
    result: np.ndarray = state[:size, None]
    return result


def test_the_registry_is_what_a_scene_may_ask_for() -> None:
    assert set(INTEGRATORS) == set(SOLVER_CHOICES["integrator"]) == set(ORDERS)


@pytest.mark.parametrize(("name", "case"), SERVED)
def test_the_motion_comes_to_the_exact_one_with_the_order_of_the_method(equation: Callable[..., EquationOfMotion], name: str, case: str) -> None:
    motion, order = equation(case), ORDERS[name]
    reference = exact(motion)
    errors = [float(np.linalg.norm(after(name, motion, steps) - reference) / np.linalg.norm(reference)) for steps in (STEPS if order else LARGE_STEPS)]
    if order is None:
        assert max(errors) < EXACT
        return
    if name == "leapfrog" and CASES[case].needs == "damping":
        order = 1  # the damping force lags half a step
    fitted = -np.polyfit(np.log(STEPS), np.log(errors), 1)[0]
    assert fitted == pytest.approx(order, abs=0.2)  # NUMERICS
    assert errors[-1] < (2e-3 if order == 1 else 5e-5)  # it is the exact motion that they come to


@pytest.mark.parametrize(("name", "case"), SERVED)
def test_many_columns_move_as_each_does_alone(equation: Callable[..., EquationOfMotion], name: str, case: str) -> None:
    together, steps = equation(case, columns=4), STEPS[0] if ORDERS[name] else LARGE_STEPS[-1]
    found = after(name, together, steps)
    loads = together.timed_loads
    for column in range(4):
        part = slice(column, column + 1)
        alone = replace(
            together,
            constant_force=together.constant_force[:, part].copy(),
            timed_loads=tuple(replace(load, force=load.force[:, part].copy()) for load in loads),
            displacement=together.displacement[:, part].copy(),
            velocity=together.velocity[:, part].copy(),
        )
        expected = after(name, alone, steps)
        np.testing.assert_allclose(found[:, part], expected, rtol=0, atol=1e-14 * np.abs(expected).max())  # sums of products in another order


@pytest.mark.parametrize(("name", "case"), SERVED)
def test_two_steps_at_once_are_two_steps(equation: Callable[..., EquationOfMotion], name: str, case: str) -> None:
    integrator = built(name, equation(case), DURATION / 320)
    once, twice = integrator.initial_state(), integrator.initial_state()
    integrator.advance(once, 2)
    integrator.advance(twice, 1)
    integrator.advance(twice, 1)
    assert once.step == twice.step == 2
    tolerance = 0 if ORDERS[name] is not None else 1e-12  # those that are exact in time take both in one stride
    for found, expected in ((once.displacement, twice.displacement), (once.velocity, twice.velocity)):
        np.testing.assert_allclose(found.numpy(), expected.numpy(), rtol=0, atol=tolerance * float(expected.abs().max()))


@pytest.mark.parametrize("name", INTEGRATORS)
def test_the_initial_state_is_new_each_time_and_that_of_the_equation(equation: Callable[..., EquationOfMotion], name: str) -> None:
    motion = equation("initial motion")
    kept = motion.displacement.copy()
    integrator = built(name, motion, DURATION / 320)
    first = integrator.initial_state()
    np.testing.assert_array_equal(first.displacement.numpy(), kept)
    integrator.advance(first, 3)
    np.testing.assert_array_equal(motion.displacement, kept)
    np.testing.assert_array_equal(integrator.initial_state().displacement.numpy(), kept)


@pytest.mark.parametrize("name", INTEGRATORS)
def test_energy_is_kept_under_a_constant_load(equation: Callable[..., EquationOfMotion], name: str) -> None:
    motion = equation("initial motion")
    integrator = built(name, motion, DURATION / 30)  # 0.9 of the stability limit
    state = integrator.initial_state()
    first, energies, works = integrator.energy(state), [], [np.abs(integrator.energy(state))]
    for _ in range(5):
        integrator.advance(state, 400)  # 10,000 steps are a reference case
        energies.append(integrator.energy(state))
        works.append(np.abs((motion.constant_force * state.displacement.numpy()).sum(axis=0)))
    assert np.abs(np.array(energies) - first).max() <= 1e-11 * np.max(works)  # NUMERICS


@pytest.mark.parametrize(("name", "what"), [(name, what) for name, kind in INTEGRATORS.items() for what in kind.refuses])
def test_what_a_method_cannot_do_is_refused_with_the_cure(
    model: ElasticModel, equation: Callable[..., EquationOfMotion], make_springs: MakeSprings, name: str, what: str
) -> None:
    plain = equation("constant load")
    refused = {
        "damping": replace(plain, damping=Damping(mass=1.0)),
        "loads that change with time": equation("ramped load"),
        "forces that follow the state": replace(plain, laws=(make_springs(model),)),
        "a consistent mass": plain,
    }[what]
    message = f"solver.integrator={name} cannot integrate {what}, which this scene has; set solver.integrator=leapfrog"
    with pytest.raises(ConfigurationError, match=f"^{re.escape(message)}$"):
        INTEGRATORS[name].check(name, refused, is_lumped=what != "a consistent mass")
    INTEGRATORS["leapfrog"].check("leapfrog", refused, is_lumped=what != "a consistent mass")  # the cure is one


@pytest.mark.parametrize("name", INTEGRATORS)
def test_only_plain_explicit_steps_run_on_another_device(equation: Callable[..., EquationOfMotion], name: str) -> None:
    kind, motion = INTEGRATORS[name], equation("constant load")
    message = "a run on cuda needs an explicit integrator, a lumped mass and no forces that follow the state; run it on the CPU"
    if kind.is_explicit:
        kind.check(name, motion, is_lumped=True, device="cuda")
    with pytest.raises(ConfigurationError, match="on cuda" if kind.is_explicit or not kind.refuses else "on cuda|a consistent mass"):
        kind.check(name, motion, is_lumped=False, device="cuda")
    if not kind.is_explicit:
        with pytest.raises(ConfigurationError, match=message):
            kind.check(name, motion, is_lumped=True, device="cuda")


@pytest.mark.parametrize("name", INTEGRATORS)
def test_each_method_says_when_not_to_use_it(name: str) -> None:
    assert re.search(r"\bNot (for|with|to)\b", INTEGRATORS[name].__doc__ or "")
