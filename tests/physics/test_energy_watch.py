"""What the energy watch holds a run to, and what it catches."""

from collections.abc import Callable

import numpy as np
import pytest
import torch

from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.effects.history import History
from sdfnet.physics.effects.roles import Damping, ForceLaw
from sdfnet.physics.elasticity import ElasticModel, assemble
from sdfnet.physics.energy_watch import ENERGY_TOLERANCE, LAW_TOLERANCE, EnergyWatch
from sdfnet.physics.integrators import Exact, Leapfrog, Modal, Newmark, SymplecticEuler
from sdfnet.physics.integrators.integrator import Integrator
from sdfnet.physics.motion import EquationOfMotion
from sdfnet.physics.stability import step_limits
from sdfnet.scene import Material

MakeBox = Callable[..., TetMesh]
MakeSprings = Callable[..., ForceLaw]
MakeEquation = Callable[..., EquationOfMotion]
RISING = History((0.0, 0.01, 0.03), (0.2, 1.0, -0.5))


def roller_foot(mesh: TetMesh) -> np.ndarray:
    fixed = np.zeros((len(mesh.nodes), 3), dtype=np.bool_)
    fixed[mesh.nodes[:, 2] <= 0.5, 2] = True
    fixed[mesh.nodes[:, 0] == 0] = True
    return fixed


@pytest.fixture(scope="module")
def model(make_box: MakeBox) -> ElasticModel:
    return assemble(make_box([0, 1, 2], [0, 1, 1.7], [0, 0.8, 2]), Material())


@pytest.fixture(scope="module")
def random_columns(model: ElasticModel) -> Callable[[int], np.ndarray]:
    count = int((~roller_foot(model.mesh)).sum())
    return lambda seed: np.random.default_rng(seed).standard_normal((count, 1))


@pytest.mark.parametrize("kind", ["lumped", "consistent"])
@pytest.mark.parametrize("loaded", [False, True])
def test_energy_watch_holds_for_ten_thousand_steps_just_below_the_limit(
    model: ElasticModel, make_equation: MakeEquation, random_columns: Callable[[int], np.ndarray], kind: str, loaded: bool
) -> None:
    fixed = roller_foot(model.mesh)
    force, velocity = (random_columns(5), None) if loaded else (0 * random_columns(5), random_columns(6))
    motion = make_equation(model, fixed, force, kind, velocity=velocity)
    integrator = SymplecticEuler(motion, 0.99 * step_limits(model, fixed).of(kind))
    watch, state = EnergyWatch(integrator), integrator.initial_state()
    energies = []
    for _ in range(100):
        assert watch.problem(state) is None
        integrator.advance(state, 100)
        energies.append(motion.energy(state.displacement.numpy(), state.velocity.numpy()))
    assert watch.problem(state) is None
    assert watch.drift <= 1e-11  # NUMERICS
    assert np.ptp(energies) > 1e-2 * np.abs(energies).max()  # the plain energy swings: the watch is not trivially constant


def test_energy_watch_sees_an_error_of_a_millionth_in_the_velocity(make_box: MakeBox, make_equation: MakeEquation) -> None:
    model = assemble(make_box([0, 1, 2], [0, 1], [0, 1, 2]), Material())
    fixed = roller_foot(model.mesh)
    motion = make_equation(model, fixed, np.ones((int((~fixed).sum()), 1)))
    integrator = Leapfrog(motion, 0.5 * step_limits(model, fixed).lumped)
    watch, state = EnergyWatch(integrator), integrator.initial_state()
    assert watch.problem(state) is None
    assert watch.drift == 0
    integrator.advance(state, 7)
    assert watch.problem(state) is None
    assert watch.drift < 1e-13
    state.velocity.mul_(1 + 1e-6)
    problem = watch.problem(state)
    assert watch.drift > ENERGY_TOLERANCE
    assert problem == f"the energy watch must hold to 1e-08, found a drift of {watch.drift:.3g}"


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e200])
@pytest.mark.parametrize("quantity", ["displacement", "velocity"])
def test_energy_watch_never_passes_what_is_not_finite(make_equation: MakeEquation, value: float, quantity: str) -> None:
    model = assemble(TetMesh(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]), np.array([[0, 1, 2, 3]])), Material())
    integrator = SymplecticEuler(make_equation(model, np.zeros((4, 3), dtype=np.bool_), np.ones((12, 1))), 1e-3)
    watch, state = EnergyWatch(integrator), integrator.initial_state()
    assert watch.problem(state) is None
    getattr(state, quantity)[0] = value
    with np.errstate(all="ignore"):
        problem = watch.problem(state)
    assert problem is not None
    assert ("every value must be finite" in problem) == (not np.isfinite(value))


@pytest.mark.parametrize("scheme", [Leapfrog, SymplecticEuler, Newmark])
@pytest.mark.parametrize("damping", [Damping(), Damping(mass=3.0, stiffness=3e-4)])
def test_loads_that_change_with_time_account_for_the_energy_that_they_bring(
    model: ElasticModel, make_equation: MakeEquation, random_columns: Callable[[int], np.ndarray], scheme: type[Leapfrog], damping: Damping
) -> None:
    fixed = roller_foot(model.mesh)
    motion = make_equation(model, fixed, 100 * random_columns(1), history=RISING, damping=damping, velocity=random_columns(2))
    integrator = scheme(motion, 0.9 * step_limits(model, fixed, damping=damping).of("lumped"))
    watch, state = EnergyWatch(integrator), integrator.initial_state()
    for _ in range(100):
        assert watch.problem(state) is None
        integrator.advance(state, 1)
    assert watch.drift <= 1e-12  # rounding
    works = abs(state.work["loads"].item())
    assert works > 1e-2 * abs(integrator.energy(state).item())  # there was something to account for


@pytest.mark.parametrize("make", [Exact, lambda motion, step: Modal(motion, step, len(motion.free))])
def test_methods_without_an_account_of_that_work_are_watched_for_finite_values(
    model: ElasticModel, make_equation: MakeEquation, random_columns: Callable[[int], np.ndarray], make: Callable[..., Integrator]
) -> None:
    integrator = make(make_equation(model, roller_foot(model.mesh), random_columns(1), history=RISING), 1e-3)
    watch, state = EnergyWatch(integrator), integrator.initial_state()
    for _ in range(20):
        assert watch.problem(state) is None
        integrator.advance(state, 1)
    assert abs(integrator.energy(state).item()) > 0
    state.velocity[3] = np.nan
    assert watch.problem(state) == "every value must be finite, found some that are not"


@pytest.mark.parametrize("scheme", [Leapfrog, SymplecticEuler])
@pytest.mark.parametrize("damping", [Damping(mass=300.0), Damping(stiffness=1e-3), Damping(mass=30.0, stiffness=1e-4)])
@pytest.mark.parametrize("fraction", [0.1, 0.99])
@pytest.mark.parametrize("moves", [0.0, 1.0])
def test_damped_steps_never_gain_energy_by_any_step_below_the_limit(
    model: ElasticModel,
    make_equation: MakeEquation,
    random_columns: Callable[[int], np.ndarray],
    scheme: type[Leapfrog] | type[SymplecticEuler],
    damping: Damping,
    fraction: float,
    moves: float,
) -> None:
    fixed = roller_foot(model.mesh)
    motion = make_equation(model, fixed, random_columns(1), damping=damping, displacement=1e-3 * moves * random_columns(3), velocity=moves * random_columns(2))
    integrator = scheme(motion, fraction * step_limits(model, fixed, damping=damping).of("lumped"))
    watch, state, energies = EnergyWatch(integrator), integrator.initial_state(), []
    for _ in range(100):
        assert watch.problem(state) is None
        energies.append(integrator.energy(state).item())
        integrator.advance(state, 1)
    assert np.diff(energies).max() <= 1e-13 * np.abs(energies).max()
    assert energies[-1] < energies[0] - 1e-3 * np.abs(energies).max()


def test_a_watch_that_remembers_goes_on_as_the_first_would(
    model: ElasticModel, make_equation: MakeEquation, random_columns: Callable[[int], np.ndarray]
) -> None:
    fixed = roller_foot(model.mesh)
    integrator = Leapfrog(make_equation(model, fixed, random_columns(1)), 0.9 * step_limits(model, fixed).lumped)
    first, second, state = EnergyWatch(integrator), EnergyWatch(integrator), integrator.initial_state()
    first.problem(state)
    integrator.advance(state, 50)
    first.problem(state)
    second.remember(first.memory())
    assert second.drift == first.drift > 0
    state.velocity.mul_(1.001)
    assert first.problem(state) == second.problem(state) is not None


@pytest.mark.parametrize(("leak", "speed", "is_caught"), [(0.0, 0.0, False), (0.0, 0.5, False), (0.5, 0.0, True), (0.5, 0.5, True)])
def test_a_force_law_must_do_the_work_that_its_stored_energy_loses_and_its_drive_puts_in(
    model: ElasticModel,
    make_equation: MakeEquation,
    random_columns: Callable[[int], np.ndarray],
    make_springs: MakeSprings,
    leak: float,
    speed: float,
    is_caught: bool,
) -> None:
    fixed = roller_foot(model.mesh)
    law = make_springs(model, share=0.1, leak=leak, speed=speed)
    step = 0.3 * step_limits(model, fixed, law.added_stiffness()).lumped
    integrator = Leapfrog(make_equation(model, fixed, 0 * random_columns(1), velocity=random_columns(4), laws=(law,)), step)
    watch, state = EnergyWatch(integrator), integrator.initial_state()
    problems = []
    for _ in range(60):
        problems.append(watch.problem(state))
        integrator.advance(state, 1)
    assert any(problem is not None and problem.startswith("force laws must keep their energy to 0.1, found") for problem in problems) == is_caught
    assert (watch.law_error > LAW_TOLERANCE) == is_caught
    assert watch.drift < 1e-12  # what the law did to the solid is accounted for, right or wrong
    assert torch.isfinite(state.displacement).all()
