"""A floor pushes what sinks into it, takes no energy, and says how far it gave way."""

from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
import torch

from sdfnet.errors import ConfigurationError, PhysicsError
from sdfnet.geometry.solids import Sphere
from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.effects.floor_contact import FloorContact
from sdfnet.physics.effects.gravity import Gravity
from sdfnet.physics.effects.initial_motion import InitialMotion
from sdfnet.physics.effects.pinned import Pinned
from sdfnet.physics.effects.rayleigh_damping import RayleighDamping
from sdfnet.physics.effects.roles import ForceLaw
from sdfnet.physics.elasticity import ElasticModel, assemble
from sdfnet.physics.plan import Plan, plan
from sdfnet.physics.regions import HalfSpace
from sdfnet.physics.simulate import SimulationStopped, run, simulate
from sdfnet.scene import Effect, Geometry, Material, Recording, Scene, Solver

MakeBox = Callable[..., TetMesh]
TILTED = (1.0, -2.0, 2.0)


@pytest.fixture(scope="module")
def cube(make_box: MakeBox) -> TetMesh:
    """A cube of edge 1 m, its foot at z = 0; the faces' edges are 1/2, 1/2 and sqrt(1/2) m."""
    return make_box([0, 0.5, 1], [0, 0.5, 1], [0, 0.5, 1])


def _law(model: ElasticModel, effect: FloorContact, fixed: np.ndarray | None = None) -> ForceLaw:
    law = effect.force_law(model, np.zeros(model.elements.nodes.shape, dtype=np.bool_) if fixed is None else fixed)
    assert law is not None
    return law


@pytest.mark.parametrize("element", ["P1", "P2"])
def test_a_flat_foot_is_pushed_with_modulus_over_edge_times_area_times_depth(cube: TetMesh, element: str) -> None:
    material = Material(youngs_modulus=2e4, poisson_ratio=0.3, density=5.0)
    model = assemble(cube, material, element)
    law, nodes = _law(model, FloorContact(stiffness_factor=3.0)), model.elements.nodes
    for depth in (0.0, 0.02, -0.02):
        force = law.force(torch.tensor([0.0, 0.0, -depth], dtype=torch.float64).expand(len(nodes), 3), 0.0)
        edge = (1 + np.sqrt(0.5)) / 3
        # The foot's nodes also stand for a part of the walls: of their lower half's area a half with linear elements, a third with quadratic ones.
        area = 1 + 4 * 0.5 * (1 / 2 if element == "P1" else 1 / 3)
        exact = 3.0 * (material.lame_lambda + 2 * material.lame_mu) / edge * area * max(depth, 0.0)
        np.testing.assert_allclose(force.sum(dim=0), [0, 0, exact], atol=1e-9)
        assert not force[nodes[:, 2] > 0].any()


def test_the_force_is_minus_the_gradient_of_the_stored_energy(cube: TetMesh) -> None:
    model = assemble(cube, Material())
    law = _law(model, FloorContact(height=-2 / 3, normal=TILTED))
    generator = torch.Generator().manual_seed(1)
    displacement, change = (scale * torch.randn(len(cube.nodes), 3, generator=generator, dtype=torch.float64) for scale in (0.3, 1e-6))
    slope = (law.stored_energy(displacement + change, 0.0) - law.stored_energy(displacement - change, 0.0)) / 2
    work = float((law.force(displacement, 0.0) * change).sum())
    assert abs(work) > 0
    assert slope == pytest.approx(-work, rel=1e-6)  # no node crosses the floor: between its two sides the energy is quadratic


def _motion(effects: dict[str, Effect], mesh: TetMesh, material: Material, share: float, steps: int, every: int) -> tuple[Plan, np.ndarray, np.ndarray, float]:
    """The plan, the centre of mass's height (m) and the energy that must be kept (J) every so many steps, and the watch's worst finding."""
    compiled = plan(Scene(Geometry(), effects, material, Recording(1.0, 2)), mesh)
    assert compiled.limits is not None
    compiled = replace(compiled, scene=replace(compiled.scene, recording=Recording(share * compiled.limits.of("lumped") * steps, 2)), steps_per_frame=steps)
    integrator, watch = compiled.compile()
    state, law, heights, totals = integrator.initial_state(), integrator.motion.laws[0], [], []
    for _ in range(steps // every):
        assert watch.problem(state) is None
        after, before = (integrator.motion.nodal(state.displacement - lag * integrator.time_step * state.velocity) for lag in (0.0, 1.0))
        heights.append(float(compiled.model.lumped_mass @ after[:, 2].numpy()) / compiled.model.lumped_mass.sum())
        totals.append(float(integrator.energy(state)[0]) + (law.stored_energy(before, 0.0) + law.stored_energy(after, 0.0)) / 2)
        integrator.advance(state, every)
    return compiled, np.array(heights), np.array(totals), watch.law_error


def test_a_nearly_rigid_ball_bounces_with_the_speed_it_came_with() -> None:
    effects = {"fall": InitialMotion(velocity=(0.0, 0.0, -0.5)), "floor": FloorContact(height=-0.0501, stiffness_factor=0.1)}
    ball = Sphere(radius=0.05, cells=4).tet_mesh()
    compiled, heights, totals, _ = _motion(effects, ball, Material(youngs_modulus=5e4), 0.9, 1200, 20)
    velocities = np.diff(heights) / (20 * compiled.time_step)
    assert velocities[0] == pytest.approx(-0.5, rel=1e-9)
    assert velocities[-1] == pytest.approx(0.5, rel=1e-3)  # what is missing rings on in the ball
    np.testing.assert_allclose(velocities[-5:], velocities[-1], rtol=1e-9)  # nothing holds it back
    np.testing.assert_allclose(totals, totals[0], rtol=1e-10)


@pytest.mark.parametrize("steps", [1000, pytest.param(10_000, marks=pytest.mark.slow)])
def test_ten_thousand_steps_of_hard_contact_neither_gain_nor_lose_energy(cube: TetMesh, steps: int) -> None:
    """At 0.99 of the step limit without the floor; a force taken once a step gains a hundredfold here."""
    effects = {"weight": Gravity((0.0, 0.0, -30.0)), "floor": FloorContact(normal=(0.0, 0.0, 2.0), stiffness_factor=100.0)}
    _, heights, totals, law_error = _motion(effects, cube, Material(), 0.99, steps, 50)
    in_play = 30 * np.abs(heights).max()
    assert in_play > 0.03
    np.testing.assert_allclose(totals, totals[0], atol=1e-11 * in_play)
    assert law_error < 1e-9


def test_a_solid_at_rest_sinks_in_by_its_weight_over_the_stiffness(cube: TetMesh, caplog: pytest.LogCaptureFixture) -> None:
    material = Material(poisson_ratio=0.0)
    depths = {}
    for factor in (0.01, 0.05):
        effects = {"weight": Gravity((0.0, 0.0, -9.81)), "floor": FloorContact(stiffness_factor=factor), "air": RayleighDamping(mass=40.0)}
        caplog.clear()
        report = simulate(Scene(Geometry(), effects, material, Recording(1.2, 7)), cube).report
        depths[factor] = float(report["floor_largest_penetration_m"])
        assert report["floor_largest_force_N"] == pytest.approx(9.81, rel=0.02)
        assert report["floor_frames_in_contact"] == 6
        assert ("the solid sinks into the floor by" in caplog.text) == (factor == 0.01)
        assert report["floor_largest_penetration_per_edge"] == pytest.approx(depths[factor] / ((1 + np.sqrt(0.5)) / 3), rel=1e-9)
    assert depths[0.01] / depths[0.05] == pytest.approx(5, rel=0.05)  # the solid's own give is not divided by five


def test_a_free_node_under_the_floor_is_refused_with_depth_and_cure(cube: TetMesh) -> None:
    model = assemble(cube, Material())
    message = r"over the floor at 0.1 m, found 9 free nodes of its surface under it, the deepest by 0.1 m at \(.*, 0\) m; pin them, or set floor.height to 0 or"
    with pytest.raises(PhysicsError, match=message):
        _law(model, FloorContact(height=0.1))


def test_nodes_that_are_held_do_not_touch_the_floor(cube: TetMesh) -> None:
    model = assemble(cube, Material())
    foot = Pinned(region=HalfSpace(point=(0.0, 0.0, 0.2))).fixed_components(model.elements)
    law = _law(model, FloorContact(height=0.1), foot)
    assert not law.added_stiffness()[foot.any(axis=1)].any()
    assert law.stored_energy(torch.zeros(len(foot), 3, dtype=torch.float64), 0.0) == 0
    sliding = foot & np.array([True, True, False])
    with pytest.raises(PhysicsError, match="9 free nodes"):
        _law(model, FloorContact(height=0.1), sliding)
    _law(model, FloorContact(height=0.1), foot & np.array([False, False, True]))  # cannot move down


@pytest.mark.parametrize("settings", [{"height": float("nan")}, {"normal": (0.0, 0.0, 0.0)}, {"stiffness_factor": -1.0}])
def test_meaningless_settings_are_refused(settings: dict[str, float]) -> None:
    with pytest.raises(ConfigurationError, match=rf"floor.{next(iter(settings))} must be finite"):
        FloorContact(**settings)  # type: ignore[arg-type]


def test_a_step_of_one_and_a_half_times_the_limit_is_caught(cube: TetMesh) -> None:
    scene = Scene(Geometry(), {"weight": Gravity((0.0, 0.0, -30.0)), "floor": FloorContact()}, Material(), Recording(1.0, 2))
    compiled = plan(scene, cube)
    assert compiled.limits is not None
    recording = Recording(1.5 * compiled.limits.of("lumped") * 400, 41)
    with pytest.raises(SimulationStopped, match="the energy watch must hold to") as caught:
        run(replace(compiled, scene=replace(scene, recording=recording), steps_per_frame=10))
    assert 10 * len(caught.value.trajectory.times) <= 200


def test_a_consistent_mass_is_refused(cube: TetMesh) -> None:
    scene = Scene(Geometry(), {"floor": FloorContact(height=-1.0)}, solver=Solver(mass="consistent"))
    with pytest.raises(ConfigurationError, match="a contact that keeps its energy needs a lumped mass, found solver.mass=consistent; set solver.mass=lumped"):
        plan(scene, cube).compile()


def test_a_run_goes_on_from_a_snapshot_in_contact_bit_for_bit(cube: TetMesh) -> None:
    effects = {"fall": InitialMotion(velocity=(0.0, 0.1, -3.0)), "floor": FloorContact()}
    compiled, kept = plan(Scene(Geometry(), effects, recording=Recording(0.02, 6)), cube), []
    whole = run(compiled, keep=lambda snapshot: kept.append(deepcopy(snapshot)))
    assert int(whole.report["floor_frames_in_contact"]) > 2
    np.testing.assert_array_equal(run(compiled, resume=kept[2]).displacements, whole.displacements)
