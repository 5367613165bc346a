"""The hyperelastic force is linear elasticity at rest, exact where W can be solved by hand, and knows a rotation."""

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch

from sdfnet.errors import ConfigurationError
from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.effects.finite_strain import STABLE_FRACTION, FiniteStrain, NeoHooke
from sdfnet.physics.effects.pinned import Pinned
from sdfnet.physics.effects.pressure_poke import PressurePoke
from sdfnet.physics.effects.prestrain import Prestrain
from sdfnet.physics.effects.rayleigh_damping import RayleighDamping
from sdfnet.physics.elasticity import ElasticModel, assemble
from sdfnet.physics.plan import Plan, plan
from sdfnet.physics.simulate import SimulationStopped, run, simulate
from sdfnet.scene import Effect, Geometry, Material, Recording, Scene

MakeBox = Callable[..., TetMesh]
MATERIALS = [Material(), Material(youngs_modulus=2e6, poisson_ratio=0.2, density=900.0)]
PUSH = PressurePoke(center=(0.5, 0.5, 1.0), radius=0.3, pressure=10.0)


@pytest.fixture(scope="module")
def cube(make_box: MakeBox) -> TetMesh:
    axis = np.linspace(0, 1, 4)
    return make_box(axis, axis, axis, jitter=0.2)


def _law(model: ElasticModel) -> NeoHooke:
    law = FiniteStrain().elastic_law(model)
    assert isinstance(law, NeoHooke)
    return law


def _forces(law: NeoHooke, displacement: np.ndarray) -> np.ndarray:
    found: np.ndarray = law.force(torch.from_numpy(displacement), 0.0).numpy().copy()
    return found


def _tangent(law: NeoHooke, displacement: np.ndarray, change: np.ndarray, step: float) -> np.ndarray:
    """Minus the force's derivative along `change`, by central differences over twice `step`, N."""
    difference: np.ndarray = (_forces(law, displacement - step * change) - _forces(law, displacement + step * change)) / (2 * step)
    return difference


@pytest.mark.parametrize("material", MATERIALS)
def test_the_tangent_at_rest_is_the_linear_stiffness(cube: TetMesh, material: Material) -> None:
    model = assemble(cube, material)
    law, change = _law(model), np.random.default_rng(0).standard_normal((len(cube.nodes), 3))
    linear = (model.stiffness @ change.ravel()).reshape(-1, 3)
    np.testing.assert_allclose(_tangent(law, 0 * change, change, 1e-6), linear, atol=1e-7 * np.abs(linear).max())  # rounding 1e-16 over a step of 1e-6


def test_nothing_at_all_is_left_of_the_force_at_rest(cube: TetMesh) -> None:
    law = _law(assemble(cube, Material()))
    assert not _forces(law, np.zeros_like(cube.nodes)).any()
    assert law.stored_energy(torch.zeros(len(cube.nodes), 3, dtype=torch.float64), 0.0) == 0
    assert not law.added_stiffness().any()


def test_a_quarter_turn_and_a_shift_cause_no_force_and_store_nothing(cube: TetMesh) -> None:
    model = assemble(cube, Material())
    law, turn = _law(model), np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    displacement = cube.nodes @ turn.T + np.array([3.0, -2.0, 1.0]) - cube.nodes
    linear = np.abs(model.stiffness @ displacement.ravel()).max()
    assert np.abs(_forces(law, displacement)).max() < 1e-12 * linear
    assert abs(law.stored_energy(torch.from_numpy(displacement), 0.0)) < 1e-12 * linear


@pytest.mark.parametrize("material", MATERIALS)
@pytest.mark.parametrize("stretch", [0.7, 1.6])
def test_a_stretched_bar_pulls_with_the_stress_of_w_and_not_at_its_sides(cube: TetMesh, material: Material, stretch: float) -> None:
    """Free sides: P_y = mu t + ((lambda + mu)(s t^2 - 1) - mu) s t = 0 gives t^2 = (1 + mu / (lambda + mu) (1 - 1/s)) / s."""
    first, mu = material.lame_lambda, material.lame_mu
    lateral = math.sqrt((1 + mu / (first + mu) * (1 - 1 / stretch)) / stretch)
    stress = mu * stretch + ((first + mu) * (stretch * lateral**2 - 1) - mu) * lateral**2
    force = _forces(_law(assemble(cube, material)), cube.nodes * (np.array([stretch, lateral, lateral]) - 1))
    ends = [force[cube.nodes[:, 0] == end].sum(axis=0) for end in (0, 1)]
    np.testing.assert_allclose(ends, [[stress, 0, 0], [-stress, 0, 0]], atol=1e-12 * material.youngs_modulus)
    inside = (cube.nodes[:, 0] > 0) & (cube.nodes[:, 0] < 1)
    np.testing.assert_allclose(force[inside], 0, atol=1e-12 * material.youngs_modulus)
    assert np.sign(stress) == np.sign(stretch - 1)
    assert abs(stress - material.youngs_modulus * (stretch - 1)) > 0.05 * abs(stress)  # linear elasticity says something else


@pytest.mark.parametrize("size", [0.02, 1.0])
def test_the_force_is_minus_the_gradient_of_the_stored_energy_also_of_inverted_tets(cube: TetMesh, size: float) -> None:
    law, random = _law(assemble(cube, Material())), np.random.default_rng(5)
    displacement, change = size * random.standard_normal(cube.nodes.shape), 1e-5 * random.standard_normal(cube.nodes.shape)
    after, before = (law.stored_energy(torch.from_numpy(displacement + sign * change), 0.0) for sign in (1, -1))
    assert (float(law.report(displacement[None], np.zeros(1))["smallest_volume_ratio"]) < 0) == (size == 1)
    assert (after - before) / 2 == pytest.approx(-float((_forces(law, displacement) * change).sum()), rel=1e-6)


def test_the_volumes_of_the_report_are_those_of_the_tets(cube: TetMesh) -> None:
    displacement = 0.2 * np.random.default_rng(2).standard_normal((2, len(cube.nodes), 3))
    corners = (cube.nodes + displacement)[:, cube.tets]
    ratios = np.linalg.det(corners[:, :, 1:] - corners[:, :, :1]) / (6 * cube.volumes)
    report = _law(assemble(cube, Material())).report(displacement, np.zeros(2))
    assert report["smallest_volume_ratio"] == pytest.approx(ratios.min(), rel=1e-9)
    assert report["largest_volume_ratio"] == pytest.approx(ratios.max(), rel=1e-9)


def _scene(**effects: Effect) -> Scene:
    return Scene(Geometry(), {"foot": Pinned(), "push": PUSH, **effects}, recording=Recording(0.02, 5))


def test_a_small_load_gives_the_linear_motion_and_the_difference_falls_with_the_load(cube: TetMesh) -> None:
    differences = []
    for pressure in (10.0, 1.0, 0.1):
        push = replace(PUSH, pressure=pressure)
        compiled = plan(_scene(push=push, strain=FiniteStrain()), cube)
        curved = run(compiled).displacements
        linear = run(replace(plan(_scene(push=push), cube), steps_per_frame=compiled.steps_per_frame)).displacements
        differences.append(np.abs(curved - linear).max() / np.abs(linear).max())
    assert differences[0] < 0.02
    np.testing.assert_allclose(np.divide(differences[:-1], differences[1:]), 10, rtol=0.1)


def test_energy_is_kept_over_a_thousand_steps_of_large_strains(cube: TetMesh) -> None:
    scene = replace(_scene(push=replace(PUSH, pressure=1000.0), strain=FiniteStrain()), recording=Recording(1.5, 11))
    compiled = plan(scene, cube)
    integrator, watch = compiled.compile()
    state = integrator.initial_state()
    for _ in range(compiled.steps // 100):
        assert watch.problem(state) is None
        integrator.advance(state, 100)
    assert compiled.steps > 1000
    assert float(state.displacement.abs().max()) > 0.05
    assert watch.drift < 1e-12
    assert watch.law_error < 0.02


def _at(share: float, steps: int, cube: TetMesh) -> Plan:
    """A cube that is pressed, with a step that is a share of the limit at rest; a hundred frames."""
    compiled = plan(_scene(strain=FiniteStrain()), cube)
    assert compiled.limits is not None
    recording = Recording(share * compiled.limits.of("lumped") / STABLE_FRACTION * steps, 101)
    return replace(compiled, scene=replace(compiled.scene, recording=recording), steps_per_frame=steps // 100)


@pytest.mark.parametrize("steps", [1000, pytest.param(10_000, marks=pytest.mark.slow)])
def test_a_step_within_the_limit_stays_stable(cube: TetMesh, steps: int) -> None:
    assert float(run(_at(0.99 * STABLE_FRACTION, steps, cube)).report["energy_drift"]) < 1e-11


def test_a_step_of_one_and_a_half_times_the_limit_is_caught(cube: TetMesh) -> None:
    with pytest.raises(SimulationStopped, match="force laws must keep their energy to|the energy watch must hold to") as caught:
        run(_at(1.5, 1000, cube))
    assert 10 * len(caught.value.trajectory.times) <= 200


@pytest.mark.parametrize("shape", [[1.9, 0.75, 0.75], [0.5, 1.26, 1.26], [1.15, 1.15, 1.15], [1.0, 1.0, 0.3]])
def test_frequencies_grow_within_what_the_step_allows_for(cube: TetMesh, shape: list[float]) -> None:
    model = assemble(cube, Material())
    law, root, highest = _law(model), np.sqrt(model.lumped_mass)[:, None], []
    for displacement in (0 * cube.nodes, cube.nodes * (np.array(shape) - 1)):
        vector = np.random.default_rng(0).standard_normal(cube.nodes.shape)
        for _ in range(300):  # power iteration: from below, and within a percent
            vector = _tangent(law, displacement, vector / root / np.linalg.norm(vector), 1e-5) / root
        highest.append(math.sqrt(np.linalg.norm(vector)))
    assert highest[1] / highest[0] < 1 / STABLE_FRACTION


def test_a_hundredfold_poke_ends_finite_or_is_stopped_with_finite_frames(cube: TetMesh) -> None:
    stopped = []
    for pressure in (1e3, 1e5, 1e7):
        scene = _scene(push=replace(PUSH, pressure=pressure), strain=FiniteStrain())
        try:
            trajectory = simulate(scene, cube)
        except SimulationStopped as caught:
            trajectory = caught.trajectory
            stopped.append(str(caught).split(": ")[-1])
        assert np.isfinite(trajectory.displacements).all()
    assert stopped == [f"lower solver.time_step or solver.safety, or weaken the loads, which are {ratio} of Young's modulus" for ratio in ("20", "2e+03")]


@pytest.mark.parametrize("element", ["P1_nodal_pressure", "P2"])
def test_other_elements_are_refused_with_the_cure(cube: TetMesh, element: str) -> None:
    with pytest.raises(ConfigurationError, match=f"finite strain needs linear tets, found solver.element={element}; set solver.element=P1"):
        FiniteStrain().elastic_law(assemble(cube, Material(), element))


def test_what_belongs_to_the_linear_force_is_refused_beside_it(cube: TetMesh) -> None:
    with pytest.raises(ConfigurationError, match="stiffness-proportional damping belongs to the linear elastic force.*use the mass-proportional part"):
        plan(_scene(strain=FiniteStrain(), air=RayleighDamping(stiffness=1e-4)), cube)
    with pytest.raises(ConfigurationError, match="'heat' is a strain of the linear elastic force, which another effect replaces here; remove one of the two"):
        plan(_scene(strain=FiniteStrain(), heat=Prestrain((0.01, 0.0, 0.0, 0.0, 0.0, 0.0))), cube)
    with pytest.raises(ConfigurationError, match="only one effect may replace the linear elastic force"):
        plan(_scene(strain=FiniteStrain(), again=FiniteStrain()), cube)
    plan(_scene(strain=FiniteStrain(), air=RayleighDamping(mass=1.0), heat=Prestrain()), cube)
