"""Says which effects a scene calls for, which it can leave out, and what each would cost and change."""

import math
import textwrap
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from sdfnet.physics.advice.costs import damping_cost, law_cost
from sdfnet.physics.advice.numbers import SMALLEST_CHANGE, SMALLEST_LOSS, Number, deformation, element_numbers, gap, strain_numbers, transits, weight_numbers
from sdfnet.physics.advice.reduced_laws import COUNTERPARTS, contact, finite_strain_excess, linear_tets
from sdfnet.physics.advice.trial import Trial
from sdfnet.physics.doubts import LARGEST_LINEAR_STRAIN
from sdfnet.physics.effects.body_force import BodyForce
from sdfnet.physics.effects.finite_strain import FiniteStrain
from sdfnet.physics.effects.floor_contact import FloorContact
from sdfnet.physics.effects.gravity import Gravity
from sdfnet.physics.effects.roles import Damping
from sdfnet.physics.plan import Plan
from sdfnet.scene import Material

TYPICAL_RATIO = 0.02  # damping ratio assumed where the scene has no damping: rubber and plastics have some hundredths
WIDTH = 120  # of the sentences under the table

CALLED_FOR, LEFT_OUT, NEEDED, COULD_GO = "called for", "can be left out", "present and needed", "present, could go"


@dataclass(frozen=True)
class Advice:
    """What one number of a scene says for or against an effect. All numbers of an effect share verdict, change and cost."""

    effect: str  # its registry name, or element, or inertia
    number: str  # name and formula
    value: float
    threshold: float  # beyond it the number by itself speaks for the effect
    verdict: str  # called for, can be left out, present and needed, or present, could go
    predicted_change: float  # of the displacements, in the mass norm over all frames, if it were added or taken away; infinite or NaN where no trial can tell
    cost: str
    sentence: str  # what to do


def advise(compiled: Plan) -> tuple[Advice, ...]:
    """Advice on gravity, damping, finite strain, floor contact, the element and inertia, from numbers and a cheap trial.

    The trial is the scene in reduced coordinates (`Trial`), once as it is and once with each effect added or taken away;
    an effect is called for when it changes the displacements by a twentieth, finite strain also where the displacement
    gradient passes the tenth up to which linear elasticity is valid. The floor is that of the scene, or z = 0.
    Raises PhysicsError when no trial stays finite. Not a proof: predicted changes were within a factor of three of real ones.
    """
    trial = Trial(compiled)
    return tuple(advice for judge in (_gravity, _damping, _finite_strain, _floor, _element, _inertia) for advice in judge(trial))


def lines(advice: Sequence[Advice]) -> list[str]:
    """A table for the screen: under each effect its numbers, what to do and what that costs."""
    table = [f"{'effect':<18}{'verdict':<20}{'change':>9}  {'number':<52}{'value':>10}{'threshold':>11}"]
    shown = ""
    for index, row in enumerate(advice):
        is_first = row.effect != shown
        shown = row.effect
        head = f"{row.effect:<18}{row.verdict:<20}{_percent(row.predicted_change):>9}" if is_first else 47 * " "
        table.append(f"{head}  {row.number:<52}{row.value:>10.3g}{row.threshold:>11.3g}")
        if index + 1 == len(advice) or advice[index + 1].effect != shown:
            table += [line for text in (row.sentence, f"cost: {row.cost}") for line in _wrapped(text)]
    return table


def typical_damping(trial: Trial) -> Damping:
    """A damping ratio of 0.02 at the frequency that governs the motion.

    In proportion to the mass, which leaves the step as it is; for a solid that flies freely to the stiffness, or its
    flight would be braked.
    """
    omega = trial.governing_frequency
    by_mass = trial.is_held or trial.compiled.demands.replaces_elasticity
    return Damping(mass=2 * TYPICAL_RATIO * omega) if by_mass else Damping(stiffness=2 * TYPICAL_RATIO / omega)


def _gravity(trial: Trial) -> list[Advice]:
    compiled, demands = trial.compiled, trial.compiled.demands
    change, acting = trial.weight_change(), [demands.loads[name] for name in trial.weight_names]
    weight = sum(load.stress * max(map(abs, load.history.values)) for load in acting)
    numbers = weight_numbers(compiled, weight or Gravity().load(compiled.model).stress, demands.stress - weight)
    verdict = _verdict(bool(acting), change >= SMALLEST_CHANGE)
    sentence = _sentence(verdict, "gravity", change)
    if verdict == CALLED_FOR and any(isinstance(effect, BodyForce) for effect in compiled.scene.effects.values()):
        sentence += ", unless the body force of this scene is the weight already"
    return _rows("gravity", numbers, verdict, change, "nothing per step while it is constant, a vector added where a history makes it change", sentence)


def _damping(trial: Trial) -> list[Advice]:
    omega, present = trial.governing_frequency, trial.compiled.demands.damping
    tried = present or typical_damping(trial)
    change = trial.damping_change(Damping() if present else tried)
    ratio = tried.ratio(omega)
    name = f"damping loss 1 - exp(-xi omega T), xi = {ratio:.2g}" + ("" if present else " assumed")
    loss = Number(name, -math.expm1(-ratio * omega * trial.compiled.scene.recording.duration), SMALLEST_LOSS)
    verdict = _verdict(bool(present), change >= SMALLEST_CHANGE)
    what = f"rayleigh_damping (mass={tried.mass:.4g} 1/s, stiffness={tried.stiffness:.4g} s)"
    return _rows("rayleigh_damping", [loss], verdict, change, damping_cost(trial.compiled, tried), _sentence(verdict, what, change))


def _finite_strain(trial: Trial) -> list[Advice]:
    compiled, is_present = trial.compiled, trial.compiled.demands.replaces_elasticity
    change = trial.law_removal(len(trial.acting.laws) - 1) if is_present else trial.law_change(finite_strain_excess(compiled))
    found = deformation(compiled.model.mesh, trial.displacements, trial.times)
    is_outside = found.gradient > LARGEST_LINEAR_STRAIN
    verdict = _verdict(is_present, change >= SMALLEST_CHANGE or is_outside)
    where = "outside" if is_outside else "within"
    sentence = (
        f"{_sentence(verdict, 'finite_strain', change)}; the scene lies {where} linear validity: "
        f"the displacement gradient reaches {found.gradient:.2g}, valid up to {LARGEST_LINEAR_STRAIN:g}"
    )
    law = compiled.demands.laws[trial.law_names[-1]] if is_present else FiniteStrain().elastic_law(linear_tets(compiled))
    needs = "" if compiled.scene.solver.element == "P1" else "; it needs solver.element=P1"
    cost = law_cost(compiled, law, True) + needs
    return _rows("finite_strain", strain_numbers(compiled, found), verdict, change, cost, sentence + _one_by_one(compiled, verdict))


def _floor(trial: Trial) -> list[Advice]:
    compiled, floors = trial.compiled, [name for name in trial.law_names if isinstance(trial.compiled.scene.effects[name], FloorContact)]
    if floors:
        index, floor = trial.law_names.index(floors[0]), compiled.scene.effects[floors[0]]
        assert isinstance(floor, FloorContact)
        law, change, height = compiled.demands.laws[floors[0]], trial.law_removal(index), gap(compiled, trial.corners_without_law(index), floor)
        verdict = _verdict(True, change >= SMALLEST_CHANGE)
        return _rows("floor_contact", [height], verdict, change, law_cost(compiled, law, False), _sentence(verdict, "floor_contact", change))
    floor = FloorContact()
    rest, height = gap(compiled, np.zeros_like(trial.displacements[:1]), floor), gap(compiled, trial.displacements, floor)
    if rest.value < 0:
        sentence = "leave floor_contact out: the solid reaches under z = 0 at rest, where no floor can be; a floor elsewhere needs its height"
        return _rows("floor_contact", [height], LEFT_OUT, math.nan, "no trial was made", sentence)
    tried = floor.force_law(compiled.model, compiled.fixed)
    assert tried is not None
    change = trial.law_change(contact(compiled, tried)) if height.value < 0 else 0.0
    verdict = _verdict(False, change >= SMALLEST_CHANGE)
    sentence = _sentence(verdict, "floor_contact at z = 0", change) + _one_by_one(compiled, verdict)
    return _rows("floor_contact", [height], verdict, change, law_cost(compiled, tried, False), sentence)


def _element(trial: Trial) -> list[Advice]:
    compiled, element = trial.compiled, trial.compiled.scene.solver.element
    numbers = element_numbers(compiled)
    if element == "P1" and not isinstance(compiled.model.material, Material):
        sentence = "keep solver.element=P1, or take P2 for bending: P1_nodal_pressure, with which it is compared, knows one material"
        return _rows("element", numbers, LEFT_OUT, math.nan, "no trial was made", sentence)
    change, entries = trial.element_change()
    locks, other, percent = numbers[0].value > numbers[0].threshold, COUNTERPARTS[element], _percent(change)
    verdict = _verdict(element != "P1", change >= SMALLEST_CHANGE and (locks or element == "P2"))
    why = "locking does not show" if locks else "nothing locks"
    words = {
        CALLED_FOR: f"set solver.element={other}: linear tets lock at this Poisson ratio, and it would change the displacements by {percent}",
        LEFT_OUT: f"keep solver.element={element}: {why}; {other} would change the displacements by {percent}",
        NEEDED: f"keep solver.element={element}: with {other} the displacements would change by {percent}",
        COULD_GO: f"solver.element={other} would do: {why}; it would change the displacements by {percent}",
    }
    if not locks and change >= SMALLEST_CHANGE and element != "P2":
        words[verdict] += ", which shows the error of the mesh: refine it or set solver.element=P2"
    if len(numbers) > 1 and numbers[1].value < numbers[1].threshold:
        words[verdict] += f"; the dent under the patch is not resolved: refine the mesh there {numbers[1].threshold / numbers[1].value:.2g} times to see it"
    cost = f"{other} has {entries:.2g} times the matrix entries, and so about the time per step"
    return _rows("element", numbers, verdict, change, cost, words[verdict])


def _inertia(trial: Trial) -> list[Advice]:
    change, steps = trial.inertia_change(), trial.compiled.steps
    is_needed = change >= SMALLEST_CHANGE or bool(trial.law_names)
    sentence = f"keep the motion: the static solution at each moment differs from it by {_percent(change)}"
    if trial.law_names:
        sentence = "keep the motion: a static solution knows no force that follows the state"
    elif not trial.is_held:
        sentence = "keep the motion: nothing holds the solid, and a static solution needs that"
    elif not is_needed:
        sentence = f"static_solution(plan) would do: it differs from the motion by {_percent(change)}"
    return _rows("inertia", [transits(trial.compiled)], _verdict(True, is_needed), change, f"{steps} steps; the static solution is one solve", sentence)


def _rows(effect: str, numbers: Sequence[Number], verdict: str, change: float, cost: str, sentence: str) -> list[Advice]:
    return [Advice(effect, number.name, number.value, number.threshold, verdict, change, cost, sentence) for number in numbers]


def _verdict(is_present: bool, is_needed: bool) -> str:
    return (NEEDED if is_needed else COULD_GO) if is_present else (CALLED_FOR if is_needed else LEFT_OUT)


def _sentence(verdict: str, what: str, change: float) -> str:
    words = {
        CALLED_FOR: f"add {what}: it would change",
        LEFT_OUT: f"leave {what} out: it would change",
        NEEDED: f"keep {what}: to go without it would change",
        COULD_GO: f"{what} could go: to go without it would change",
    }
    return f"{words[verdict]} the displacements by {_percent(change)}"


def _one_by_one(compiled: Plan, verdict: str) -> str:
    return "; simulate the load cases one by one then" if compiled.scene.load_cases and verdict == CALLED_FOR else ""


def _wrapped(text: str) -> list[str]:
    return textwrap.wrap(text, WIDTH, initial_indent=4 * " ", subsequent_indent=8 * " ")


def _percent(change: float) -> str:
    if math.isnan(change):
        return "unknown"
    return "no bound" if math.isinf(change) else f"{100 * change:.2g} %" if change < 1 else f"{100 * change:.0f} %"
