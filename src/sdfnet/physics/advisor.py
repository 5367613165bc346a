"""Says which effects a scene calls for, which it can leave out, and what each would cost and change."""

import math
import textwrap
from collections.abc import Sequence

import numpy as np

from sdfnet.physics.advice.costs import damping_cost, law_cost
from sdfnet.physics.advice.element import element_advice
from sdfnet.physics.advice.numbers import SMALLEST_CHANGE, SMALLEST_LOSS, Number, deformation, gap, strain_numbers, transits, weight_numbers
from sdfnet.physics.advice.reduced_laws import contact, finite_strain_excess, linear_tets
from sdfnet.physics.advice.trial import Trial
from sdfnet.physics.advice.wording import CALLED_FOR, IF_THERE, LEFT_OUT, Advice, one_by_one, percent, rows_of, verdict_on, what_to_do
from sdfnet.physics.doubts import LARGEST_LINEAR_STRAIN
from sdfnet.physics.effects.body_force import BodyForce
from sdfnet.physics.effects.finite_strain import FiniteStrain
from sdfnet.physics.effects.floor_contact import FloorContact
from sdfnet.physics.effects.gravity import Gravity
from sdfnet.physics.effects.roles import Damping
from sdfnet.physics.plan import Plan

TYPICAL_RATIO = 0.02  # damping ratio assumed where the scene has no damping: rubber and plastics have some hundredths
WIDTH = 120  # of the sentences under the table


def advise(compiled: Plan) -> tuple[Advice, ...]:
    """Advice on gravity, damping, finite strain, floor contact, the element and inertia, from numbers and a cheap trial.

    The trial is the scene in reduced coordinates (`Trial`), once as it is and once with each effect added or taken away;
    an effect is called for when it changes the displacements by a twentieth, finite strain also where the displacement
    gradient passes the tenth up to which linear elasticity is valid. A scene without a floor is told of one at z = 0
    where it would pass that. The element is asked for its static answer too, beside that of P2.
    Raises PhysicsError when no trial stays finite. Not a proof: predicted changes were within a factor of three of real
    ones, but for those of finite strain over 100 %, which are only said to be that.
    """
    trial = Trial(compiled)
    return tuple(advice for judge in (_gravity, _damping, _finite_strain, _floor, element_advice, _inertia) for advice in judge(trial))


def lines(advice: Sequence[Advice]) -> list[str]:
    """A table for the screen: under each effect its numbers, what to do and what that costs."""
    table = [f"{'effect':<18}{'verdict':<20}{'change':>9}  {'number':<52}{'value':>10}{'threshold':>11}"]
    shown = ""
    for index, row in enumerate(advice):
        is_first = row.effect != shown
        shown = row.effect
        head = f"{row.effect:<18}{row.verdict:<20}{row.change:>9}" if is_first else 47 * " "
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
    return Damping(mass=2 * TYPICAL_RATIO * omega) if trial.is_held else Damping(stiffness=2 * TYPICAL_RATIO / omega)


def _gravity(trial: Trial) -> list[Advice]:
    compiled, demands = trial.compiled, trial.compiled.demands
    change, acting = trial.weight_change(), [demands.loads[name] for name in trial.weight_names]
    weight = sum(load.stress * max(map(abs, load.history.values)) for load in acting)
    numbers = weight_numbers(compiled, weight or Gravity().load(compiled.model).stress, demands.stress - weight)
    verdict = verdict_on(bool(acting), change >= SMALLEST_CHANGE)
    sentence = what_to_do(verdict, "gravity", percent(change))
    if verdict == CALLED_FOR and any(isinstance(effect, BodyForce) for effect in compiled.scene.effects.values()):
        sentence += ", unless the body force of this scene is the weight already"
    return rows_of("gravity", numbers, verdict, change, "nothing per step while it is constant, a vector added where a history makes it change", sentence)


def _damping(trial: Trial) -> list[Advice]:
    omega, present = trial.governing_frequency, trial.compiled.demands.damping
    if not present and not trial.is_held and trial.compiled.demands.replaces_elasticity:
        sentence = "leave rayleigh_damping out: its mass part would brake the flight of a solid that nothing holds, its stiffness part knows no finite_strain"
        loss = Number("damping loss 1 - exp(-xi omega T), none assumed", 0.0, SMALLEST_LOSS)
        return rows_of("rayleigh_damping", [loss], LEFT_OUT, math.nan, "no trial was made", sentence)
    tried = present or typical_damping(trial)
    change = trial.damping_change(Damping() if present else tried)
    ratio = tried.ratio(omega)
    name = f"damping loss 1 - exp(-xi omega T), xi = {ratio:.2g}" + ("" if present else " assumed")
    loss = Number(name, -math.expm1(-ratio * omega * trial.compiled.scene.recording.duration), SMALLEST_LOSS)
    verdict = verdict_on(bool(present), change >= SMALLEST_CHANGE)
    what = f"rayleigh_damping (mass={tried.mass:.4g} 1/s, stiffness={tried.stiffness:.4g} s)"
    return rows_of("rayleigh_damping", [loss], verdict, change, damping_cost(trial.compiled, tried), what_to_do(verdict, what, percent(change)))


def _finite_strain(trial: Trial) -> list[Advice]:
    compiled, is_present = trial.compiled, trial.compiled.demands.replaces_elasticity
    change = trial.law_removal(len(trial.acting.laws) - 1) if is_present else trial.law_change(finite_strain_excess(compiled))
    found = deformation(compiled.model.mesh, trial.displacements, trial.times)
    is_outside = found.gradient > LARGEST_LINEAR_STRAIN
    verdict = verdict_on(is_present, change >= SMALLEST_CHANGE or is_outside)
    where = "outside" if is_outside else "within"
    sentence = (
        f"{what_to_do(verdict, 'finite_strain', percent(change, 'finite_strain'))}; the scene lies {where} linear validity: "
        f"the displacement gradient reaches {found.gradient:.2g}, valid up to {LARGEST_LINEAR_STRAIN:g}"
    )
    law = compiled.demands.laws[trial.law_names[-1]] if is_present else FiniteStrain().elastic_law(linear_tets(compiled))
    needs = "" if compiled.scene.solver.element == "P1" else "; it needs solver.element=P1"
    cost = law_cost(compiled, law, True) + needs
    return rows_of("finite_strain", strain_numbers(compiled, found), verdict, change, cost, sentence + one_by_one(compiled, verdict))


def _floor(trial: Trial) -> list[Advice]:
    compiled, floors = trial.compiled, [name for name in trial.law_names if isinstance(trial.compiled.scene.effects[name], FloorContact)]
    if floors:
        index, floor = trial.law_names.index(floors[0]), compiled.scene.effects[floors[0]]
        assert isinstance(floor, FloorContact)
        law, change, height = compiled.demands.laws[floors[0]], trial.law_removal(index), gap(compiled, trial.corners_without_law(index), floor)
        verdict = verdict_on(True, change >= SMALLEST_CHANGE)
        return rows_of("floor_contact", [height], verdict, change, law_cost(compiled, law, False), what_to_do(verdict, "floor_contact", percent(change)))
    floor = FloorContact()
    rest, height = gap(compiled, np.zeros_like(trial.displacements[:1]), floor), gap(compiled, trial.displacements, floor)
    if rest.value < 0:
        sentence = "leave floor_contact out: the solid reaches under z = 0 at rest, where no floor can be; a floor elsewhere needs its height"
        return rows_of("floor_contact", [height], LEFT_OUT, math.nan, "no trial was made", sentence)
    tried = floor.force_law(compiled.model, compiled.fixed)
    assert tried is not None
    change = trial.law_change(contact(compiled, tried)) if height.value < 0 else 0.0
    if change >= SMALLEST_CHANGE:  # a scene that names no floor may well have none
        sentence = f"the solid would pass z = 0: add floor_contact if a floor is there, it would change the displacements by {percent(change)}"
        sentence += one_by_one(compiled, IF_THERE)
        return rows_of("floor_contact", [height], IF_THERE, change, law_cost(compiled, tried, False), sentence)
    sentence = what_to_do(LEFT_OUT, "floor_contact at z = 0", percent(change))
    return rows_of("floor_contact", [height], LEFT_OUT, change, law_cost(compiled, tried, False), sentence)


def _inertia(trial: Trial) -> list[Advice]:
    change, steps = trial.inertia_change(), trial.compiled.steps
    is_needed = change >= SMALLEST_CHANGE or bool(trial.law_names)
    sentence = f"keep the motion: the static solution at each moment differs from it by {percent(change)}"
    if trial.law_names:
        sentence = "keep the motion: a static solution knows no force that follows the state"
    elif not trial.is_held:
        sentence = "keep the motion: nothing holds the solid, and a static solution needs that"
    elif not is_needed:
        sentence = f"static_solution(plan) would do: it differs from the motion by {percent(change)}"
    return rows_of("inertia", [transits(trial.compiled)], verdict_on(True, is_needed), change, f"{steps} steps; the static solution is one solve", sentence)


def _wrapped(text: str) -> list[str]:
    return textwrap.wrap(text, WIDTH, initial_indent=4 * " ", subsequent_indent=8 * " ")
