"""A solid of several materials: exact answers, true steps, and whole runs with a contrast of a million."""

import re
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.linalg import eigh

from sdfnet.errors import ConfigurationError, PhysicsError
from sdfnet.geometry.solids import Box
from sdfnet.physics.advisor import advise
from sdfnet.physics.effects.contact import wave_moduli
from sdfnet.physics.effects.finite_strain import FiniteStrain
from sdfnet.physics.effects.floor_contact import FloorContact
from sdfnet.physics.effects.gravity import Gravity
from sdfnet.physics.effects.inclusion import Inclusion
from sdfnet.physics.effects.pinned import Pinned
from sdfnet.physics.effects.pressure_poke import PressurePoke
from sdfnet.physics.effects.prestrain import Prestrain
from sdfnet.physics.effects.traction import Traction
from sdfnet.physics.energy_watch import ENERGY_TOLERANCE
from sdfnet.physics.integrators import INTEGRATORS
from sdfnet.physics.plan import Plan, plan
from sdfnet.physics.regions import Ball, BoxRegion, HalfSpace
from sdfnet.physics.simulate import run, simulate
from sdfnet.physics.stability import step_limits
from sdfnet.physics.statics import static_solution
from sdfnet.plugins import frozen, writable
from sdfnet.scene import Effect, Material, Recording, Scene, Solver

Solution = Callable[[Plan], np.ndarray]
SOFT = Material(5e3, 0.0, 1.0)
BAR = Box(size=(2.0, 1.0, 1.0), cells=(4, 2, 2))
END = BoxRegion(lower=(1.25, -np.inf, -np.inf))  # the tets over x = 1.25 do not fill a layer of cells: their centroids do not lie in one plane
HALF = BoxRegion(lower=(1.0, -np.inf, -np.inf))
WALL = Pinned(HalfSpace(normal=(1.0, 0.0, 0.0)))
PULL = Traction(BoxRegion(lower=(2.0, -np.inf, -np.inf)), (10.0, 0.0, 0.0))
ELEMENTS = ("P1", "P2")


def scene_of(solver: Solver | None = None, material: Material = SOFT, **effects: Effect) -> Scene:
    return Scene(BAR, effects, material, Recording(0.1, 6), Solver() if solver is None else solver)


def stiffened(factor: float, density: float = 1.0, poisson_ratio: float = 0.0) -> Inclusion:
    return Inclusion(HALF, Material(factor * SOFT.youngs_modulus, poisson_ratio, density))


@pytest.mark.parametrize("element", ELEMENTS)
@pytest.mark.parametrize("factor", [3.0, 1e6, 1e-6])
def test_two_materials_in_series_stretch_each_by_its_own_modulus(element: str, factor: float) -> None:
    compiled = plan(scene_of(Solver("newmark", element=element), wall=WALL, pull=PULL, core=stiffened(factor)), BAR.tet_mesh())
    found, x = static_solution(compiled), compiled.model.elements.nodes[:, 0]
    exact = 10.0 / SOFT.youngs_modulus * (np.minimum(x, 1.0) + np.maximum(x - 1.0, 0.0) / factor)  # F/A (L1/E1 + L2/E2)
    np.testing.assert_allclose(found[:, 0], exact, rtol=0, atol=1e-7 * exact.max())  # rounding times the contrast, and the condition of the matrix
    np.testing.assert_allclose(found[:, 1:], 0.0, atol=1e-7 * exact.max())


@pytest.mark.parametrize("element", ELEMENTS)
def test_two_materials_in_series_held_sideways_stretch_each_by_its_own_wave_modulus(element: str) -> None:
    sides = Pinned(BoxRegion(), components=(False, True, True))
    core = Inclusion(HALF, Material(2e4, 0.4, 1.0))
    compiled = plan(scene_of(Solver("newmark", element=element), Material(5e3, 0.1, 1.0), wall=WALL, sides=sides, pull=PULL, core=core), BAR.tet_mesh())
    found, x = static_solution(compiled), compiled.model.elements.nodes[:, 0]
    soft, stiff = (modulus * (1 - nu) / ((1 + nu) * (1 - 2 * nu)) for modulus, nu in ((5e3, 0.1), (2e4, 0.4)))  # lambda + 2 mu
    exact = 10.0 * (np.minimum(x, 1.0) / soft + np.maximum(x - 1.0, 0.0) / stiff)
    np.testing.assert_allclose(found[:, 0], exact, rtol=0, atol=1e-10 * exact.max())


@pytest.mark.parametrize("element", ELEMENTS)
def test_each_material_has_its_own_mass_and_weight(element: str) -> None:
    compiled = plan(scene_of(Solver(element=element), core=stiffened(1.0, density=4.0), weight=Gravity()), BAR.tet_mesh())
    assert compiled.model.lumped_mass.sum() == pytest.approx(1.0 + 4.0, rel=1e-12)
    assert compiled.model.consistent_mass.sum() == pytest.approx(1.0 + 4.0, rel=1e-12)
    of_node = compiled.demands.loads["weight"].nodal_force[:, 2]
    assert of_node.sum() == pytest.approx(-9.81 * 5.0, rel=1e-12)
    assert (of_node * compiled.model.elements.nodes[:, 0]).sum() == pytest.approx(-9.81 * (1.0 * 0.5 + 4.0 * 1.5), rel=1e-12)  # at its centres
    assert compiled.demands.loads["weight"].stress == pytest.approx(4.0 * 9.81)  # of the heaviest, one metre high


@pytest.mark.parametrize("element", ELEMENTS)
def test_what_swells_everywhere_alike_does_so_without_stress_whatever_it_is_made_of(element: str) -> None:
    held = {(0.0, 0.0, 0.0): (True, True, True), (2.0, 0.0, 0.0): (False, True, True), (0.0, 1.0, 0.0): (False, False, True)}
    effects = {f"hold {place}": Pinned(Ball(place, 1e-6), components) for place, components in held.items()}
    heat = Prestrain((0.01, -0.02, 0.03, 0.0, 0.0, 0.0))
    core = Inclusion(END, Material(5e5, 0.45, 1.0))
    compiled = plan(scene_of(Solver("newmark", element=element), material=Material(), **effects, heat=heat, core=core), BAR.tet_mesh())
    np.testing.assert_allclose(static_solution(compiled), compiled.model.elements.nodes * [0.01, -0.02, 0.03], atol=1e-10)


@pytest.mark.parametrize("element", ELEMENTS)
@pytest.mark.parametrize("more", [{}, {"floor": FloorContact(height=-1e-4, stiffness_factor=1.0)}, {"strain": FiniteStrain()}])
def test_an_inclusion_of_the_same_material_changes_nothing(element: str, more: dict[str, Effect]) -> None:
    if element == "P2" and "strain" in more:
        pytest.skip("finite strain needs linear tets")
    heat = {} if "strain" in more else {"heat": Prestrain((0.01, 0.0, 0.0, 0.0, 0.002, 0.0))}
    scene = scene_of(Solver(element=element), Material(), wall=WALL, weight=Gravity((0.0, 0.0, -300.0)), **heat, **more)
    expected, found = (simulate(replace(scene, effects={**scene.effects, **core}), BAR.tet_mesh()) for core in ({}, {"core": Inclusion(END, Material())}))
    largest = np.abs(expected.displacements).max()
    assert largest > 1e-3
    np.testing.assert_allclose(found.displacements, expected.displacements, rtol=0, atol=1e-11 * largest)
    for name, value in expected.report.items():
        if isinstance(value, float) and not name.endswith(("seconds", "drift", "error")):
            assert found.report[name] == pytest.approx(value, rel=1e-9), name


def test_without_an_inclusion_the_material_is_that_of_the_scene_itself() -> None:
    scene = scene_of(wall=WALL, pull=PULL)
    assert plan(scene, BAR.tet_mesh()).model.material is scene.material


def test_finite_strain_begins_as_the_linear_force_of_every_material() -> None:
    scene = scene_of(material=Material(), wall=WALL, core=Inclusion(END, Material(4e4, 0.2, 3.0)), strain=FiniteStrain())
    compiled = plan(scene, BAR.tet_mesh())
    motion = np.random.default_rng(0).standard_normal((len(BAR.tet_mesh().nodes), 3))
    law = compiled.demands.laws["strain"]
    slope = (law.force(torch.from_numpy(1e-6 * motion), 0.0).numpy().copy() - law.force(torch.from_numpy(-1e-6 * motion), 0.0).numpy()) / 2e-6
    expected = -(compiled.model.stiffness @ motion.ravel()).reshape(-1, 3)
    np.testing.assert_allclose(slope, expected, atol=1e-8 * np.abs(expected).max())  # a central difference
    potential = [law.stored_energy(torch.from_numpy(size * motion), 0.0) for size in (0.999, 1.001)]
    work = -float((law.force(torch.from_numpy(motion), 0.0).numpy() * motion).sum())
    assert (potential[1] - potential[0]) / 0.002 == pytest.approx(work, rel=1e-4)


def test_contact_pushes_on_a_face_with_the_modulus_of_the_tet_behind_it() -> None:
    mesh = BAR.tet_mesh()
    model = plan(scene_of(wall=WALL, core=stiffened(9.0)), mesh).model
    of_faces = mesh.nodes[mesh.boundary_faces].mean(axis=1)[:, 0]
    np.testing.assert_array_equal(wave_moduli(model), np.where(of_faces > 1.0, 9.0, 1.0) * SOFT.youngs_modulus)  # nu = 0: E


@pytest.mark.parametrize("element", ELEMENTS)
def test_step_bounds_hold_and_the_stiff_tets_are_named(element: str) -> None:
    compiled = plan(scene_of(Solver(element=element), Material(), wall=WALL, core=Inclusion(END, Material(5e9, 0.0, 2.0))), BAR.tet_mesh())
    free = np.flatnonzero(~compiled.fixed.ravel())
    for kind, mass in (("lumped", np.diag(compiled.model.lumped_mass)), ("consistent", compiled.model.consistent_mass.toarray())):
        parts = compiled.model.stiffness.toarray()[np.ix_(free, free)], np.kron(mass, np.eye(3))[np.ix_(free, free)]
        truth = 2 / np.sqrt(eigh(*parts, eigvals_only=True)[-1])
        limits = step_limits(compiled.model, compiled.fixed)
        assert limits.of(kind) == pytest.approx(truth, rel=1e-7)
        bound = limits.element_lumped if kind == "lumped" else limits.element_consistent
        assert 0.15 * truth < bound <= truth * (1 + 1e-9)
    assert 0.15 * limits.lumped < limits.gershgorin <= limits.lumped * (1 + 1e-9)
    assert ", of Young's modulus 5e+09 Pa; without" in limits.governing
    assert limits.courant == pytest.approx(BAR.tet_mesh().smallest_edge / Material(5e9, 0.0, 2.0).pressure_wave_speed)


CONTRAST = Scene(
    Box(size=(1.0, 1.0, 1.0), cells=(3, 3, 3)),
    {
        "foot": Pinned(),
        "push": PressurePoke((0.5, 0.5, 1.0), 0.25, 10.0),
        "core": Inclusion(BoxRegion((0.3, 0.3, 0.3), (0.7, 0.7, 0.7)), Material(5e9, 0.3, 1.0)),
    },
    Material(5e3, 0.3, 1.0),
    Recording(4e-3, 5),
)
TOLERANCE = {"leapfrog": 1e-4, "symplectic_euler": 0.01, "newmark": 2e-3, "modal": 1e-6, "exact": 1e-6}  # by their orders; modal has all modes


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_a_core_a_million_times_as_stiff_moves_right(exact_in_time: Solution, integrator: str) -> None:
    compiled = plan(replace(CONTRAST, solver=Solver(integrator, modes=1000)), CONTRAST.geometry.tet_mesh())  # type: ignore[attr-defined]
    found, exact = run(compiled), exact_in_time(compiled)
    np.testing.assert_allclose(found.displacements, exact, rtol=0, atol=TOLERANCE[integrator] * np.abs(exact).max())
    assert float(found.report["energy_drift"]) <= 1e-2 * ENERGY_TOLERANCE


def test_the_plan_says_what_a_stiff_core_costs() -> None:
    mesh = CONTRAST.geometry.tet_mesh()  # type: ignore[attr-defined]
    compiled, soft = plan(CONTRAST, mesh), plan(replace(CONTRAST, effects={name: CONTRAST.effects[name] for name in ("foot", "push")}), mesh)
    assert compiled.limits is not None
    assert soft.limits is not None
    assert compiled.limits.lumped < 3e-3 * soft.limits.lumped  # a thousand times the speed of sound, in tets that share nodes with soft ones
    text = compiled.describe()
    assert "core: Inclusion makes 6 tets of another material (Young's modulus 5e+09 Pa, Poisson ratio 0.3, density 1 kg/m^3)" in text
    assert re.search(r"governed by tet \d+ at .* m, smallest altitude .* m, of Young's modulus 5e\+09 Pa", text)
    assert f"{compiled.steps} steps, " in text
    assert "s predicted for the steps" in text


def test_the_advisor_knows_solids_of_several_materials() -> None:
    rows = advise(plan(CONTRAST, CONTRAST.geometry.tet_mesh()))  # type: ignore[attr-defined]
    advice, numbers = {row.effect: row for row in rows}, {row.number: row.value for row in rows}
    assert numbers["K / mu"] == pytest.approx(2 * 1.3 / (3 * 0.4))  # both have a Poisson ratio of 0.3
    assert "set solver.element=P2 or refine the mesh" in advice["element"].sentence
    assert set(advice) >= {"gravity", "finite_strain", "floor_contact", "element"}


@pytest.mark.parametrize(
    ("solver", "effects", "message"),
    [
        (
            Solver(),
            {"core": replace(stiffened(2.0), region=Ball((9.0, 0.0, 0.0), 0.1))},
            "an inclusion must hold the centroid of a tet, found none: Ball.* nearest",
        ),
        (
            Solver(),
            {"a": stiffened(2.0), "b": Inclusion(END, Material())},
            "a tet has one material, found .* in 'a' and in 'b'; make the regions of the two disjoint",
        ),
        (
            Solver(element="P1_nodal_pressure"),
            {"core": stiffened(2.0)},
            "would average the pressure of unlike materials where they meet; set solver.element=P1 or P2",
        ),
    ],
)
def test_inclusions_that_cannot_be_are_refused(solver: Solver, effects: dict[str, Effect], message: str) -> None:
    with pytest.raises((ConfigurationError, PhysicsError), match=message):
        plan(scene_of(solver, SOFT, wall=WALL, **effects), BAR.tet_mesh())


def test_a_soft_core_is_what_a_load_is_measured_by(caplog: pytest.LogCaptureFixture) -> None:
    compiled = plan(scene_of(wall=WALL, pull=PULL, core=stiffened(1e-3)), BAR.tet_mesh())
    assert compiled.report["load_over_youngs_modulus"] == pytest.approx(2.0)
    assert any("outside linear elasticity: the load is 2 of Young's modulus" in message for message in caplog.messages)


@pytest.mark.parametrize(
    ("element", "ratio", "cure"), [("P1", 0.46, "set solver.element=P2"), ("P2", 0.4995, "lower the Poisson ratio, or compare with a finer mesh")]
)
def test_a_core_that_locks_is_warned_of_with_a_cure_that_several_materials_allow(
    element: str, ratio: float, cure: str, caplog: pytest.LogCaptureFixture
) -> None:
    plan(scene_of(Solver(element=element), wall=WALL, core=stiffened(1.0, poisson_ratio=ratio)), BAR.tet_mesh())
    assert any(f"Poisson ratio {ratio:g} > " in message and message.endswith(f"look too stiff; {cure}") for message in caplog.messages)


def test_an_inclusion_survives_the_way_through_a_configuration() -> None:
    assert frozen(writable(stiffened(7.0))) == stiffened(7.0)
