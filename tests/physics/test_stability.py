"""The step limits against dense eigenvalues, their guaranteed bounds, and damping."""

from collections.abc import Callable

import numpy as np
import pytest
import torch
from scipy.linalg import eigh
from scipy.spatial import Delaunay

from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.effects.roles import Damping
from sdfnet.physics.elasticity import ElasticModel, assemble
from sdfnet.physics.integrators import Leapfrog, SymplecticEuler
from sdfnet.physics.motion import EquationOfMotion
from sdfnet.physics.stability import damped_limit, step_limits
from sdfnet.scene import SOLVER_CHOICES, Material

MakeBox = Callable[..., TetMesh]
MakeEquation = Callable[..., EquationOfMotion]
ELEMENTS = SOLVER_CHOICES["element"]
MATERIALS = [Material(), Material(youngs_modulus=2.1e11, poisson_ratio=0.29, density=7850.0), Material(poisson_ratio=-0.3)]


def roller_foot(model: ElasticModel) -> np.ndarray:
    nodes = model.elements.nodes
    fixed = np.zeros(nodes.shape, dtype=np.bool_)
    fixed[nodes[:, 2] <= 0.5, 2] = True
    fixed[nodes[:, 0] == 0] = True
    return fixed


def random_tets(generator: np.random.Generator, count: int = 20) -> TetMesh:
    """The Delaunay tets of random points, without the flattest hundredth."""
    nodes = generator.uniform(size=(count, 3))
    tets = Delaunay(nodes).simplices.astype(np.int64)
    volumes = np.linalg.det(nodes[tets[:, 1:]] - nodes[tets[:, :1]])
    tets[volumes < 0] = tets[volumes < 0][:, [0, 2, 1, 3]]
    tets = tets[np.abs(volumes) > np.quantile(np.abs(volumes), 0.01)]
    used, renumbered = np.unique(tets, return_inverse=True)
    return TetMesh(nodes[used], renumbered.reshape(tets.shape))


def dense_limit(model: ElasticModel, fixed: np.ndarray, kind: str, added: np.ndarray | None = None) -> float:
    free = np.flatnonzero(~fixed.ravel())
    scalar = np.diag(model.lumped_mass) if kind == "lumped" else model.consistent_mass.toarray()
    stiffness = model.stiffness.toarray() + (0 if added is None else np.diag(np.repeat(added, 3)))
    eigenvalues = eigh(stiffness[np.ix_(free, free)], np.kron(scalar, np.eye(3))[np.ix_(free, free)], eigvals_only=True)
    return float(2 / np.sqrt(eigenvalues[-1]))


@pytest.fixture(scope="module")
def mesh(make_box: MakeBox) -> TetMesh:
    return make_box(np.linspace(0, 0.4, 4), np.linspace(0, 0.5, 4), np.geomspace(0.2, 1.2, 5), jitter=0.3)


@pytest.mark.parametrize("material", MATERIALS)
@pytest.mark.parametrize("held", [False, True])
def test_true_limits_are_those_of_the_dense_eigenproblem(mesh: TetMesh, material: Material, held: bool) -> None:
    model = assemble(mesh, material)
    fixed = roller_foot(model) if held else np.zeros((len(mesh.nodes), 3), dtype=np.bool_)
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


@pytest.mark.parametrize("element", ELEMENTS)
@pytest.mark.parametrize("material", MATERIALS)
@pytest.mark.parametrize("jitter", [0.0, 0.25])
def test_guaranteed_bounds_stay_below_the_truth_and_are_of_use(make_box: MakeBox, material: Material, jitter: float, element: str) -> None:
    cells = 3 if element == "P2" else 5
    model = assemble(make_box(np.linspace(0, 1, cells), np.linspace(0, 1, cells), np.linspace(0, 1.5, cells), jitter), material, element)
    limits = step_limits(model, roller_foot(model))
    for bound, truth in ((limits.gershgorin, limits.lumped), (limits.element_lumped, limits.lumped), (limits.element_consistent, limits.consistent)):
        assert (0.2 if element != "P1_nodal_pressure" else 0.15) * truth < bound <= truth * (1 + 1e-9)  # a tet by itself does not average its pressure


@pytest.mark.parametrize("element", ELEMENTS)
@pytest.mark.parametrize("seed", [0, 1, 2])
@pytest.mark.parametrize("strength", [0.0, 30.0])
def test_the_bounds_hold_on_random_meshes_and_with_the_stiffness_of_contact(element: str, seed: int, strength: float) -> None:
    generator = np.random.default_rng(seed)
    mesh = random_tets(generator)
    model = assemble(mesh, Material(poisson_ratio=generator.uniform(-0.9, 0.49), density=generator.uniform(0.1, 10)), element)
    fixed = np.zeros(model.elements.nodes.shape, dtype=np.bool_)
    added = strength * model.stiffness.diagonal().max() * generator.uniform(size=len(fixed)) ** 8  # a few nodes in hard contact
    limits = step_limits(model, fixed, added)
    assert limits.lumped == pytest.approx(dense_limit(model, fixed, "lumped", added), rel=1e-7)
    assert limits.consistent == pytest.approx(dense_limit(model, fixed, "consistent", added), rel=1e-7)
    assert limits.gershgorin <= limits.lumped * (1 + 1e-9)
    assert limits.element_lumped <= limits.lumped * (1 + 1e-9)
    assert limits.element_consistent <= limits.consistent * (1 + 1e-9)


def test_the_element_bound_of_a_single_quadratic_tet_in_contact_is_no_looser_than_its_mass_demands() -> None:
    model = assemble(TetMesh(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]), np.array([[0, 1, 2, 3]])), Material(), "P2")
    fixed, added = np.zeros((10, 3), dtype=np.bool_), 1e12 * model.lumped_mass  # so stiff that the springs alone count
    limits = step_limits(model, fixed, added)
    assert limits.element_consistent == pytest.approx(dense_limit(model, fixed, "consistent", added), rel=1e-4)
    assert limits.element_lumped == pytest.approx(dense_limit(model, fixed, "lumped", added), rel=1e-4)


@pytest.mark.parametrize("element", ["P1", "P2"])
def test_the_tet_that_is_named_is_the_one_with_the_highest_frequency_by_itself(element: str) -> None:
    mesh = random_tets(np.random.default_rng(4), count=9)
    model, alone = assemble(mesh, Material(), element), []
    for tet in mesh.tets:
        single = assemble(TetMesh(mesh.nodes[tet], np.array([[0, 1, 2, 3]])), Material(), element)
        alone.append(dense_limit(single, np.zeros(single.elements.nodes.shape, dtype=np.bool_), "lumped"))
    limits = step_limits(model, np.zeros(model.elements.nodes.shape, dtype=np.bool_))
    worst = int(np.argmin(alone))
    assert limits.governing_tet == worst
    assert limits.element_lumped == pytest.approx(alone[worst], rel=1e-9)
    x, y, z = mesh.nodes[mesh.tets[worst]].mean(axis=0)
    assert limits.governing.startswith(f"tet {worst} at ({x:.4g}, {y:.4g}, {z:.4g}) m, smallest altitude {mesh.smallest_altitudes[worst]:.3g} m; without")
    assert limits.lines()[-1] == f"governed by {limits.governing}"
    assert f"{limits.courant:.3g} s, {limits.courant / limits.lumped:.2g} and" in limits.words()


@pytest.mark.parametrize("scheme", [Leapfrog, SymplecticEuler])
@pytest.mark.parametrize("ratio", [0.0, 0.05, 0.5, 2.0])
@pytest.mark.parametrize("by_mass", [True, False])
def test_damping_shortens_the_step_of_a_mode_to_two_times_root_of_one_plus_ratio_squared_minus_ratio(
    make_equation: MakeEquation, scheme: type[Leapfrog] | type[SymplecticEuler], ratio: float, by_mass: bool
) -> None:
    model = assemble(TetMesh(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]), np.array([[0, 1, 2, 3]])), Material())
    fixed = np.ones((4, 3), dtype=np.bool_)
    fixed[3, 2] = False  # one degree of freedom, so one mode
    omega = 2 / dense_limit(model, fixed, "lumped")
    damping = Damping(mass=2 * ratio * omega) if by_mass else Damping(stiffness=2 * ratio / omega)
    assert damping.ratio(omega) == pytest.approx(ratio)
    motion = make_equation(model, fixed, np.zeros((1, 2)), damping=damping)
    stable, unstable = 0.01 / omega, 3 / omega
    while unstable > 1.001 * stable:
        step = (stable + unstable) / 2
        stable, unstable = (step, unstable) if growth(scheme(motion, step)) <= 1 else (stable, step)
    assert stable * omega == pytest.approx(2 * (np.sqrt(1 + ratio**2) - ratio), rel=0.01)  # NUMERICS
    assert damped_limit(omega, damping) == pytest.approx(stable, rel=0.002)
    assert step_limits(model, fixed, damping=damping).of("lumped") == pytest.approx(damped_limit(omega, damping), rel=1e-9)


def growth(integrator: Leapfrog | SymplecticEuler) -> float:
    """The largest factor by which one step multiplies the displacement and velocity of a single degree of freedom; 1 + 1e-9 for rounding."""
    state = integrator.initial_state()
    state.displacement[:], state.velocity[:] = torch.tensor([[1.0, 0.0]]), torch.tensor([[0.0, 1.0]])
    integrator.advance(state, 1)
    factors = np.linalg.eigvals(np.stack([state.displacement.numpy()[0], state.velocity.numpy()[0]]))
    return float(np.abs(factors).max()) - 1e-9


def test_the_fastest_mode_has_the_shortest_step_whatever_the_damping() -> None:
    omegas = np.geomspace(1, 1e4, 50)
    for damping in (Damping(), Damping(mass=100.0), Damping(stiffness=1e-3), Damping(mass=50.0, stiffness=1e-2)):
        assert (np.diff([damped_limit(omega, damping) for omega in omegas]) < 0).all()


def test_holding_nodes_never_shortens_the_step(mesh: TetMesh) -> None:
    model = assemble(mesh, Material())
    free, held = (step_limits(model, fixed) for fixed in (np.zeros((len(mesh.nodes), 3), dtype=np.bool_), roller_foot(model)))
    assert held.lumped > free.lumped * (1 + 1e-6)  # this foot holds the smallest tets
    assert held.consistent > free.consistent * (1 + 1e-6)


def test_the_paper_limit_is_edge_over_wave_speed_and_is_called_unsafe_where_it_is(mesh: TetMesh) -> None:
    model = assemble(mesh, Material())
    limits = step_limits(model, roller_foot(model))
    assert limits.courant == pytest.approx(mesh.smallest_edge / 103.51, rel=1e-4)  # c_p of material A, NUMERICS
    assert limits.courant > limits.consistent
    unsafe = [kind for kind in ("lumped", "consistent") if limits.courant > limits.of(kind)]
    flagged = [line for line in limits.lines() if "NOT SAFE" in line]
    assert len(flagged) == len(unsafe)
    assert all("CFL" in line and f"{kind} mass" in line for line, kind in zip(flagged, unsafe, strict=True))
