"""The step limits against dense eigenvalues, what happens on either side of them, and the energy watch."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from scipy.linalg import eigh

from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.elasticity import ElasticModel, assemble
from sdfnet.physics.integrators.symplectic_euler import SymplecticEuler
from sdfnet.physics.mass import mass_of
from sdfnet.physics.stability import EnergyWatch, step_limits
from sdfnet.scene import Material

MakeBox = Callable[..., TetMesh]
MATERIALS = [Material(), Material(youngs_modulus=2.1e11, poisson_ratio=0.29, density=7850.0), Material(poisson_ratio=-0.3)]


def roller_foot(mesh: TetMesh) -> np.ndarray:
    fixed = np.zeros((len(mesh.nodes), 3), dtype=np.bool_)
    fixed[mesh.nodes[:, 2] <= 0.5, 2] = True
    fixed[mesh.nodes[:, 0] == 0] = True
    return fixed


def dense_limit(model: ElasticModel, fixed: np.ndarray, kind: str) -> float:
    free = np.flatnonzero(~fixed.ravel())
    scalar = np.diag(model.lumped_mass) if kind == "lumped" else model.consistent_mass.toarray()
    eigenvalues = eigh(model.stiffness.toarray()[np.ix_(free, free)], np.kron(scalar, np.eye(3))[np.ix_(free, free)], eigvals_only=True)
    return float(2 / np.sqrt(eigenvalues[-1]))


@pytest.fixture(scope="module")
def mesh(make_box: MakeBox) -> TetMesh:
    return make_box(np.linspace(0, 0.4, 4), np.linspace(0, 0.5, 4), np.geomspace(0.2, 1.2, 5), jitter=0.3)


@pytest.mark.parametrize("material", MATERIALS)
@pytest.mark.parametrize("held", [False, True])
def test_true_limits_are_those_of_the_dense_eigenproblem(mesh: TetMesh, material: Material, held: bool) -> None:
    model = assemble(mesh, material)
    fixed = roller_foot(mesh) if held else np.zeros((len(mesh.nodes), 3), dtype=np.bool_)
    limits = step_limits(model, fixed)
    assert limits.lumped == pytest.approx(dense_limit(model, fixed, "lumped"), rel=1e-7)  # Lanczos stops at 1e-9 of omega^2
    assert limits.consistent == pytest.approx(dense_limit(model, fixed, "consistent"), rel=1e-7)
    assert limits.consistent < limits.lumped
    assert (limits.of("lumped"), limits.of("consistent")) == (limits.lumped, limits.consistent)


def test_the_limits_of_a_single_tet_need_no_lanczos() -> None:
    model = assemble(TetMesh(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]), np.array([[0, 1, 2, 3]])), Material())
    fixed = np.zeros((4, 3), dtype=np.bool_)
    limits = step_limits(model, fixed)
    assert limits.lumped == pytest.approx(dense_limit(model, fixed, "lumped"), rel=1e-12)
    assert limits.consistent == pytest.approx(dense_limit(model, fixed, "consistent"), rel=1e-12)
    assert limits.element_lumped == pytest.approx(limits.lumped, rel=1e-12)  # one element: its bound is the truth
    assert limits.element_consistent == pytest.approx(limits.consistent, rel=1e-12)


@pytest.mark.parametrize("material", MATERIALS)
@pytest.mark.parametrize("jitter", [0.0, 0.25])
def test_guaranteed_bounds_stay_below_the_truth_and_are_of_use(make_box: MakeBox, material: Material, jitter: float) -> None:
    mesh = make_box(np.linspace(0, 1, 5), np.linspace(0, 1, 5), np.linspace(0, 1.5, 5), jitter)
    limits = step_limits(assemble(mesh, material), roller_foot(mesh))
    for bound, truth in ((limits.gershgorin, limits.lumped), (limits.element_lumped, limits.lumped), (limits.element_consistent, limits.consistent)):
        assert 0.2 * truth < bound <= truth * (1 + 1e-9)


def test_holding_nodes_never_shortens_the_step(mesh: TetMesh) -> None:
    model = assemble(mesh, Material())
    free, held = (step_limits(model, fixed) for fixed in (np.zeros((len(mesh.nodes), 3), dtype=np.bool_), roller_foot(mesh)))
    assert held.lumped > free.lumped * (1 + 1e-6)  # this foot holds the smallest tets
    assert held.consistent > free.consistent * (1 + 1e-6)


def test_the_paper_limit_is_edge_over_wave_speed_and_is_called_unsafe_where_it_is(mesh: TetMesh) -> None:
    limits = step_limits(assemble(mesh, Material()), roller_foot(mesh))
    assert limits.courant == pytest.approx(mesh.smallest_edge / 103.51, rel=1e-4)  # c_p of material A, NUMERICS
    assert limits.courant > limits.consistent
    unsafe = [kind for kind in ("lumped", "consistent") if limits.courant > limits.of(kind)]
    flagged = [line for line in limits.lines() if "NOT SAFE" in line]
    assert len(flagged) == len(unsafe)
    assert all("CFL" in line and f"{kind} mass" in line for line, kind in zip(flagged, unsafe, strict=True))


@pytest.mark.parametrize("kind", ["lumped", "consistent"])
@pytest.mark.parametrize("loaded", [False, True])
def test_energy_watch_holds_for_ten_thousand_steps_just_below_the_limit(make_box: MakeBox, kind: str, loaded: bool) -> None:
    mesh = make_box([0, 1, 2], [0, 1, 1.7], [0, 0.8, 2])
    model, fixed = assemble(mesh, Material()), roller_foot(mesh)
    free = np.flatnonzero(~fixed.ravel())
    generator = np.random.default_rng(5)
    force = generator.standard_normal((len(free), 1)) if loaded else np.zeros((len(free), 1))
    stiffness, mass, time_step = model.stiffness[free][:, free], mass_of(kind, model, fixed), 0.99 * step_limits(model, fixed).of(kind)
    integrator, watch = SymplecticEuler(stiffness, mass, force, time_step, "rest"), EnergyWatch(stiffness, mass, force, time_step)
    state = integrator.initial_state()
    if not loaded:
        state.velocity += torch.from_numpy(generator.standard_normal((len(free), 1)))
    drifts, energies = [], []
    for _ in range(100):
        drifts.append(watch.drift(state.displacement.numpy(), state.velocity.numpy()))
        integrator.advance(state, 100)
        u, v = state.displacement.numpy(), state.velocity.numpy()
        energies.append(float(0.5 * (v * mass.product(v)).sum() + 0.5 * (u * (stiffness @ u)).sum() - (force * u).sum()))
    assert max(drifts) <= 1e-11  # NUMERICS
    assert np.ptp(energies) > 1e-2 * np.abs(energies).max()  # the plain energy swings: the watch is not trivially constant


def test_energy_watch_sees_an_error_of_a_millionth_in_the_velocity(make_box: MakeBox) -> None:
    mesh = make_box([0, 1, 2], [0, 1], [0, 1, 2])
    model, fixed = assemble(mesh, Material()), roller_foot(mesh)
    free = np.flatnonzero(~fixed.ravel())
    force = np.ones((len(free), 1))
    stiffness, mass, time_step = model.stiffness[free][:, free], mass_of("lumped", model, fixed), 0.5 * step_limits(model, fixed).lumped
    integrator, watch = SymplecticEuler(stiffness, mass, force, time_step, "half_kick"), EnergyWatch(stiffness, mass, force, time_step)
    state = integrator.initial_state()
    assert watch.drift(state.displacement.numpy(), state.velocity.numpy()) == 0
    integrator.advance(state, 7)
    assert watch.drift(state.displacement.numpy(), state.velocity.numpy()) < 1e-13
    assert watch.drift(state.displacement.numpy(), (1 + 1e-6) * state.velocity.numpy()) > 1e-8


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e200])
def test_energy_watch_never_passes_what_is_not_finite(value: float) -> None:
    model = assemble(TetMesh(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]), np.array([[0, 1, 2, 3]])), Material())
    force, rest = np.ones((12, 1)), np.zeros((12, 1))
    watch = EnergyWatch(model.stiffness, mass_of("lumped", model, np.zeros((4, 3), dtype=np.bool_)), force, 1e-3)
    broken = rest.copy()
    broken[0] = value
    assert watch.drift(rest, rest) == 0
    with np.errstate(all="ignore"):
        assert not watch.drift(broken, rest) <= 1e-8
        assert not watch.drift(rest, broken) <= 1e-8
