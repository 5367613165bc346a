"""Advice against ablation: the same scene really run with and without each effect, where the answer is yes and where it is no."""

import math
import re
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from sdfnet.geometry.solids import Box, Sphere
from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.advice.numbers import SMALLEST_CHANGE
from sdfnet.physics.advice.trial import Trial
from sdfnet.physics.advice.wording import ANOTHER, CALLED_FOR, CHEAPER, COULD_GO, IF_THERE, LEFT_OUT, NEEDED, SUFFICES, Advice
from sdfnet.physics.advisor import advise, lines, typical_damping
from sdfnet.physics.effects.body_force import BodyForce
from sdfnet.physics.effects.finite_strain import FiniteStrain
from sdfnet.physics.effects.floor_contact import FloorContact
from sdfnet.physics.effects.gravity import Gravity
from sdfnet.physics.effects.history import ramp
from sdfnet.physics.effects.initial_motion import InitialMotion
from sdfnet.physics.effects.pinned import Pinned
from sdfnet.physics.effects.pressure_poke import PressurePoke
from sdfnet.physics.effects.rayleigh_damping import RayleighDamping
from sdfnet.physics.elasticity import assemble
from sdfnet.physics.integrators import Leapfrog
from sdfnet.physics.plan import plan
from sdfnet.physics.regions import HalfSpace
from sdfnet.physics.simulate import run
from sdfnet.physics.statics import static_solution
from sdfnet.physics.trajectory import Trajectory
from sdfnet.scene import Effect, Geometry, Material, Recording, Scene, Solver

FACTOR = 3.0  # predicted changes are promised within it, both ways

Case = tuple[Scene, TetMesh]


def lifted(mesh: TetMesh, height: float) -> TetMesh:
    return TetMesh(mesh.nodes + [0.0, 0.0, height], mesh.tets)


FOOT: dict[str, Effect] = {"foot": Pinned()}
WALL: dict[str, Effect] = {"wall": Pinned(HalfSpace(normal=(1.0, 0.0, 0.0)))}
BLOCK = Box((0.1, 0.1, 0.1), (5, 5, 5)).tet_mesh()
BEAM = lifted(Box((0.2, 0.03, 0.03), (12, 2, 2)).tet_mesh(), 0.02)
BALL = lifted(Sphere(0.05, 6).tet_mesh(), 0.05)
DROPPED = lifted(Sphere(0.05, 4).tet_mesh(), 0.051)


@cache  # the same object for the same numbers, so that it is advised on once
def block(pressure: float, duration: float = 0.01, **settings: object) -> Case:
    """A block on its foot, pressed on top."""
    effects = FOOT | {"poke": PressurePoke((0.05, 0.05, 0.1), 0.02, pressure)}
    return Scene(Geometry(), effects, recording=Recording(duration, 21), **settings), BLOCK  # type: ignore[arg-type]


@cache
def beam(pressure: float) -> Case:
    """A beam out of a wall, 2 cm over the floor, pressed down at its end."""
    effects = WALL | {"poke": PressurePoke((0.19, 0.015, 0.05), 0.01, pressure)}
    return Scene(Geometry(), effects, recording=Recording(0.04, 21)), BEAM


@cache
def ball(pressure: float) -> Case:
    """A ball held in its lower third, pressed on top."""
    effects = {"foot": Pinned(HalfSpace((0.0, 0.0, 0.03))), "poke": PressurePoke((0.0, 0.0, 0.1), 0.015, pressure)}
    return Scene(Geometry(), effects, recording=Recording(0.004, 11)), BALL


@cache
def dropped(duration: float) -> Case:
    """A ball thrown down from a millimetre over the floor."""
    return Scene(Geometry(), {"throw": InitialMotion(velocity=(0.0, 0.0, -1.0))}, recording=Recording(duration, 21)), DROPPED


def with_effect(case: Case, name: str, effect: Effect) -> Case:
    return replace(case[0], effects={**case[0].effects, name: effect}), case[1]


ADVISED: dict[int, tuple[Case, tuple[Advice, ...]]] = {}  # by the case's id, the case itself beside its advice so that the id stays its own


def advice_on(effect: str, case: Case) -> Advice:
    if id(case) not in ADVISED:
        ADVISED[id(case)] = case, advise(plan(*case))
    return next(row for row in ADVISED[id(case)][1] if row.effect == effect)


def real_change(case: Case, other: Case) -> float:
    """Both really run, with one and the same step: the difference of two steps would count as the effect's."""
    plans = [plan(*case), plan(*other)]
    step = min(compiled.time_step for compiled in plans)
    first, second = (
        run(compiled if compiled.time_step == step else plan(replace(scene, solver=replace(scene.solver, time_step=step)), mesh))
        for compiled, (scene, mesh) in zip(plans, (case, other), strict=True)
    )
    return relative_difference(second, first)


def relative_difference(other: Trajectory, reference: Trajectory) -> float:
    """||u - r|| / ||r||, squares weighed by the mass at each node and summed over all frames."""
    weights = assemble(reference.mesh, Material()).lumped_mass[:, None]
    squares = [(weights * displacements**2).sum() for displacements in (other.displacements - reference.displacements, reference.displacements)]
    return math.sqrt(squares[0] / squares[1])


def assert_within_factor(predicted: float, real: float) -> None:
    assert real / FACTOR <= predicted <= real * FACTOR, f"predicted {predicted:.4g}, real {real:.4g}"


@pytest.mark.parametrize(("case", "verdict"), [(beam(8.0), CALLED_FOR), (block(20.0), CALLED_FOR), (block(4000.0), LEFT_OUT), (dropped(0.001), LEFT_OUT)])
def test_gravity_changes_as_much_as_predicted(case: Case, verdict: str) -> None:
    advice = advice_on("gravity", case)
    assert advice.verdict == verdict
    assert_within_factor(advice.predicted_change, real_change(case, with_effect(case, "weight", Gravity())))


@pytest.mark.parametrize(("case", "verdict"), [(block(40.0), CALLED_FOR), (beam(8.0), LEFT_OUT), (block(40.0, 0.001), LEFT_OUT)])
def test_damping_changes_as_much_as_predicted(case: Case, verdict: str) -> None:
    advice, damping = advice_on("rayleigh_damping", case), typical_damping(Trial(plan(*case)))
    assert advice.verdict == verdict
    assert_within_factor(advice.predicted_change, real_change(case, with_effect(case, "damping", RayleighDamping(damping.mass, damping.stiffness))))


# The poke on a block and that on a ball are the paper's scene, p / E = 0.8; the beam turns far under a small load.
@pytest.mark.parametrize(
    ("case", "verdict"), [(block(4000.0), CALLED_FOR), (ball(4000.0), CALLED_FOR), (beam(30.0), CALLED_FOR), (block(20.0), LEFT_OUT), (beam(1.0), LEFT_OUT)]
)
def test_finite_strain_changes_as_much_as_predicted(case: Case, verdict: str) -> None:
    advice = advice_on("finite_strain", case)
    assert advice.verdict == verdict
    assert_within_factor(advice.predicted_change, real_change(case, with_effect(case, "finite", FiniteStrain())))


def test_a_change_of_finite_strain_over_one_is_only_said_to_be_that() -> None:
    row = replace(advice_on("finite_strain", block(20.0)), predicted_change=1.96)  # a real run has changed by 16.1 there
    assert row.change == "over 100 %"
    assert replace(row, predicted_change=0.96).change == "96 %"
    assert replace(row, effect="gravity").change == "196 %"  # a linear trial keeps count
    assert " over 100 %  " in lines([row])[1]


@pytest.mark.parametrize(("case", "verdict"), [(dropped(0.005), IF_THERE), (beam(30.0), IF_THERE), (dropped(0.0012), LEFT_OUT)])
def test_a_floor_changes_as_much_as_predicted(case: Case, verdict: str) -> None:
    advice = advice_on("floor_contact", case)
    assert advice.verdict == verdict
    assert advice.value < advice.threshold == 0
    assert advice.sentence.startswith("the solid would pass z = 0: add floor_contact if a floor is there, it would change") == (verdict == IF_THERE)
    assert_within_factor(advice.predicted_change, real_change(case, with_effect(case, "floor", FloorContact())))


def test_a_floor_out_of_reach_changes_nothing() -> None:
    advice = advice_on("floor_contact", beam(1.0))
    assert (advice.verdict, advice.predicted_change) == (LEFT_OUT, 0.0)
    assert advice.value > 0


def test_nodal_pressure_in_place_of_tets_that_lock_changes_as_much_as_predicted() -> None:
    case = block(20.0, material=Material(poisson_ratio=0.49))
    advice = advice_on("element", case)
    assert advice.verdict == ANOTHER
    assert advice.sentence.startswith("set solver.element=P1_nodal_pressure: linear tets lock at this Poisson ratio")
    assert_within_factor(advice.predicted_change, real_change(case, (replace(case[0], solver=Solver(element="P1_nodal_pressure")), case[1])))


def bent(cells: tuple[int, int, int], element: str = "P1", poisson_ratio: float = 0.4, duration: float = 0.04) -> Case:
    """A beam out of a wall that bends under its weight, from rest."""
    effects = WALL | {"weight": BodyForce((0.0, 0.0, -1.0))}
    scene = Scene(Geometry(), effects, Material(poisson_ratio=poisson_ratio), Recording(duration, 21), Solver("newmark", element=element))
    return scene, Box((0.2, 0.03, 0.03), cells).tet_mesh()


def weighed(element: str = "P1", poisson_ratio: float = 0.0) -> Case:
    """A block that sinks a little under its weight: nothing bends."""
    effects = FOOT | {"weight": BodyForce((0.0, 0.0, -1.0))}
    return Scene(Geometry(), effects, Material(poisson_ratio=poisson_ratio), Recording(0.003, 21), Solver("newmark", element=element)), BLOCK


@pytest.mark.parametrize(
    ("case", "verdict"),
    [
        (bent((12, 1, 1)), ANOTHER),
        (bent((12, 2, 2), poisson_ratio=0.0), ANOTHER),
        (bent((12, 1, 1), "P1_nodal_pressure"), ANOTHER),
        (weighed(), SUFFICES),
    ],
)
def test_quadratic_tets_change_as_much_as_predicted(case: Case, verdict: str) -> None:
    rows = [row for row in advise(plan(*case)) if row.effect == "element"]
    quadratic = replace(case[0], solver=Solver("newmark", element="P2"))
    assert {row.verdict for row in rows} == {verdict}
    assert_within_factor(
        rows[0].predicted_change, real_change((replace(case[0], solver=replace(case[0].solver, integrator="newmark")), case[1]), (quadratic, case[1]))
    )
    static = next(row for row in rows if row.number == "static answer of P2, change of displacements")
    linear, exact = static_solution(plan(*case)), static_solution(plan(quadratic, case[1]))[: len(case[1].nodes)]
    assert_within_factor(static.value, float(np.linalg.norm(exact - linear) / np.linalg.norm(linear)))
    assert (static.value > static.threshold) == (verdict == ANOTHER)


def test_a_beam_too_stiff_in_bending_is_told_so_with_the_cure_and_what_it_costs() -> None:
    scene, mesh = bent((6, 1, 1), duration=0.005)
    advice = advice_on("element", (scene, mesh))
    assert advice.sentence.startswith(
        "set solver.element=P2 or refine the mesh: these tets are too stiff here, as in bending; the static answer of P2 differs by "
    )
    assert re.fullmatch("P2 has [0-9.]+ times the matrix entries, and so about the time per step", advice.cost)
    explicit = advice_on("element", (replace(scene, solver=Solver()), mesh))
    assert explicit.cost == f"{advice.cost}; it needs about twice the steps"
    finite = advice_on("element", (replace(scene, effects=scene.effects | {"finite": FiniteStrain()}, solver=Solver()), mesh))
    assert finite.sentence.startswith("refine the mesh (finite_strain knows no P2): ")


@pytest.mark.parametrize(("poisson_ratio", "verdict"), [(0.3, CHEAPER)])
def test_linear_tets_in_place_of_nodal_pressure_change_as_much_as_predicted(poisson_ratio: float, verdict: str) -> None:
    case = weighed("P1_nodal_pressure", poisson_ratio)
    advice = advice_on("element", case)
    assert advice.verdict == verdict
    assert_within_factor(advice.predicted_change, real_change(case, weighed("P1", poisson_ratio)))


def test_a_solid_in_which_nothing_strains_may_keep_its_element() -> None:
    advice = advice_on("element", dropped(0.005))
    assert (advice.verdict, advice.predicted_change) == (SUFFICES, 0.0)


def test_linear_tets_in_place_of_quadratic_ones_change_as_much_as_predicted() -> None:
    mesh = lifted(Box((0.2, 0.03, 0.03), (8, 1, 1)).tet_mesh(), 0.02)
    linear, quadratic = ((replace(beam(1.0)[0], solver=Solver("newmark", element=element)), mesh) for element in ("P1", "P2"))
    advice = advice_on("element", quadratic)
    assert advice.verdict == NEEDED
    assert_within_factor(advice.predicted_change, real_change(quadratic, linear))


@pytest.mark.parametrize(("rise", "verdict"), [(None, NEEDED), (0.1, COULD_GO)])
def test_the_static_solution_differs_from_the_motion_as_much_as_predicted(rise: float | None, verdict: str) -> None:
    scene, mesh = block(40.0, 0.1)
    if rise is not None:
        scene = replace(scene, effects=FOOT | {"poke": PressurePoke((0.05, 0.05, 0.1), 0.02, 40.0, history=ramp(rise))})
    advice, compiled = advice_on("inertia", (scene, mesh)), plan(scene, mesh)
    factors = np.ones(21) if rise is None else np.linspace(0, 1, 21)
    moved, static = run(compiled), np.multiply.outer(factors, static_solution(compiled))
    assert advice.verdict == verdict
    assert_within_factor(advice.predicted_change, relative_difference(replace(moved, displacements=static), moved))


@pytest.mark.parametrize(
    ("effect", "present", "case", "verdict"),
    [
        ("gravity", Gravity(), block(20.0), NEEDED),
        ("gravity", Gravity(), block(4000.0), COULD_GO),
        ("rayleigh_damping", RayleighDamping(mass=100.0), block(40.0), NEEDED),
        ("rayleigh_damping", RayleighDamping(mass=1.0), block(40.0), COULD_GO),
        ("finite_strain", FiniteStrain(), block(4000.0, 0.005), NEEDED),
        ("finite_strain", FiniteStrain(), block(20.0, 0.005), COULD_GO),
        ("floor_contact", FloorContact(), dropped(0.005), NEEDED),
        ("floor_contact", FloorContact(), dropped(0.0012), COULD_GO),
    ],
)
def test_an_effect_that_is_present_is_needed_as_much_as_predicted(effect: str, present: Effect, case: Case, verdict: str) -> None:
    whole = with_effect(case, "present", present)
    advice = advice_on(effect, whole)
    assert advice.verdict == verdict
    assert_within_factor(advice.predicted_change, real_change(whole, case))


def test_the_papers_poke_lies_outside_linear_validity() -> None:
    for case in (block(4000.0), ball(4000.0)):
        rows = [row for row in advise(plan(*case)) if row.effect == "finite_strain"]
        numbers = {row.number: row for row in rows}
        assert numbers["load strain p / E"].value == pytest.approx(0.8)
        assert numbers["patch indentation 2 (1 - nu^2) p / E, of its radius"].value == pytest.approx(2 * 0.84 * 0.8)
        assert all(row.verdict == CALLED_FOR and "outside linear validity" in row.sentence for row in rows)


def test_a_gradient_over_a_tenth_calls_for_finite_strain_where_little_else_changes() -> None:
    advice = advice_on("finite_strain", ball(800.0))
    assert advice.predicted_change < SMALLEST_CHANGE  # the dent is strained, the ball is not
    assert advice.verdict == CALLED_FOR


def test_no_step_is_taken_for_advice(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Leapfrog, "advance", lambda *_: pytest.fail("a real step was taken"))
    assert advise(plan(*block(40.0)))


def test_a_hundredfold_poke_is_advised_on_without_breaking_down() -> None:
    advice = advice_on("finite_strain", block(400_000.0))
    assert advice.verdict == CALLED_FOR
    assert advice.predicted_change > 0.1


def test_the_strongest_load_case_stands_for_all() -> None:
    scene, mesh = block(40.0)
    pokes = {name: PressurePoke((0.05, 0.05, 0.1), 0.02, pressure) for name, pressure in (("weak", 5.0), ("strong", 40.0))}
    cases = replace(scene, effects=dict(FOOT), load_cases=dict(pokes))
    whole, alone = advise(plan(cases, mesh)), advise(plan(scene, mesh))
    assert [row.predicted_change for row in whole] == pytest.approx([row.predicted_change for row in alone], rel=1e-6)


def test_a_free_solid_keeps_its_motion_and_is_not_braked_by_typical_damping() -> None:
    case = dropped(0.005)
    assert (advice_on("inertia", case).verdict, advice_on("inertia", case).predicted_change) == (NEEDED, math.inf)
    assert typical_damping(Trial(plan(*case))).mass == 0
    assert advice_on("rayleigh_damping", case).predicted_change < 1e-9  # a flight without strain


def test_no_damping_is_suggested_that_would_brake_a_flight() -> None:
    advice = advice_on("rayleigh_damping", with_effect(dropped(0.005), "finite", FiniteStrain()))
    assert advice.verdict == LEFT_OUT
    assert math.isnan(advice.predicted_change)
    assert "would brake the flight of a solid that nothing holds" in advice.sentence


@pytest.mark.parametrize("case", [block(40.0), ball(800.0)])
def test_damping_that_was_suggested_is_needed_once_it_is_there(case: Case) -> None:
    damping = typical_damping(Trial(plan(*case)))
    assert advice_on("rayleigh_damping", case).verdict == CALLED_FOR
    assert advice_on("rayleigh_damping", with_effect(case, "damping", RayleighDamping(damping.mass, damping.stiffness))).verdict == NEEDED


def test_no_floor_is_tried_inside_the_solid() -> None:
    advice = advice_on("floor_contact", (dropped(0.005)[0], lifted(DROPPED, -0.05)))
    assert advice.verdict == LEFT_OUT
    assert math.isnan(advice.predicted_change)
    assert "under z = 0 at rest" in advice.sentence


def test_the_table_shows_every_number_and_each_verdict_once() -> None:
    advice = advise(plan(*block(4000.0)))
    table, verdicts = lines(advice), {row.effect: row.verdict for row in advice}
    heads = [line for line in table[1:] if not line.startswith(" ")]
    assert [line.split()[0] for line in heads] == list(verdicts)
    assert all(verdict in line for verdict, line in zip(verdicts.values(), heads, strict=True))
    assert all(sum(row.number in line for line in table) == 1 for row in advice)
    assert sum("cost:" in line for line in table) == len(verdicts) == 6
    assert max(map(len, table)) <= 130
