"""Advice on the element: whether linear tets lock or are too stiff in bending, and whether a costlier element is needed."""

from collections.abc import Sequence

from sdfnet.physics.advice.numbers import SMALLEST_CHANGE, Number, element_numbers, quadratic_number
from sdfnet.physics.advice.quadratic_tets import entries_beside_linear
from sdfnet.physics.advice.reduced_laws import linear_tets
from sdfnet.physics.advice.trial import Trial
from sdfnet.physics.advice.wording import ANOTHER, CHEAPER, NEEDED, SUFFICES, Advice, percent, rows_of
from sdfnet.scene import Material


def element_advice(trial: Trial) -> list[Advice]:
    """P1 beside P1_nodal_pressure where that cures its locking, else beside P2; P1_nodal_pressure beside P2 and P1; P2 beside P1."""
    compiled, element = trial.compiled, trial.compiled.scene.solver.element
    numbers = element_numbers(compiled)
    locks = numbers[0].value > numbers[0].threshold
    if element == "P2":
        return _beside_linear(trial, numbers, locks)
    if element == "P1" and locks and isinstance(compiled.model.material, Material):
        change, entries = trial.element_change()
        if change >= SMALLEST_CHANGE:
            return _beside_nodal_pressure(numbers, change, entries)
    static, change = trial.quadratic_change()
    numbers.insert(1, quadratic_number(static))
    if element == "P1_nodal_pressure" and static < SMALLEST_CHANGE:
        return _beside_linear(trial, numbers, locks)
    return _beside_quadratic(trial, numbers, static, change)


def _beside_nodal_pressure(numbers: Sequence[Number], change: float, entries: float) -> list[Advice]:
    found = f"linear tets lock at this Poisson ratio, and it would change the displacements by {percent(change)}; P2 cures stiffness in bending as well"
    return rows_of("element", numbers, ANOTHER, change, _cost("P1_nodal_pressure", entries), f"set solver.element=P1_nodal_pressure: {found}{_dent(numbers)}")


def _beside_quadratic(trial: Trial, numbers: Sequence[Number], static: float, change: float) -> list[Advice]:
    compiled, element = trial.compiled, trial.compiled.scene.solver.element
    cure = "refine the mesh (finite_strain knows no P2)" if compiled.demands.replaces_elasticity else "set solver.element=P2 or refine the mesh"
    verdict, found = SUFFICES, f"the static answer of P2 differs by {percent(static)}, its motion by {percent(change)}"
    sentence = f"keep solver.element={element}: {found}"
    if static >= SMALLEST_CHANGE:
        verdict, sentence = ANOTHER, f"{cure}: these tets are too stiff here, as in bending; {found}"
    elif change >= SMALLEST_CHANGE:
        sentence += f", for their vibrations drift apart; where that counts, {cure}"
    steps = "" if compiled.limits is None else "; it needs about twice the steps"
    cost = _cost("P2", entries_beside_linear(linear_tets(compiled))) + steps
    return rows_of("element", numbers, verdict, change, cost, sentence + _dent(numbers))


def _beside_linear(trial: Trial, numbers: Sequence[Number], locks: bool) -> list[Advice]:
    element, (change, entries) = trial.compiled.scene.solver.element, trial.element_change()
    is_needed = change >= SMALLEST_CHANGE and (locks or element == "P2")
    why = "locking does not show" if locks else "nothing locks"
    sentence = f"solver.element=P1 would do: {why}; it would change the displacements by {percent(change)}"
    if is_needed:
        sentence = f"keep solver.element={element}: with P1 the displacements would change by {percent(change)}"
    elif change >= SMALLEST_CHANGE:
        sentence += ", which shows the error of the mesh: refine it or set solver.element=P2"
    return rows_of("element", numbers, NEEDED if is_needed else CHEAPER, change, _cost("P1", entries), sentence + _dent(numbers))


def _cost(other: str, entries: float) -> str:
    return f"{other} has {entries:.2g} times the matrix entries, and so about the time per step"


def _dent(numbers: Sequence[Number]) -> str:
    patch = numbers[-1]
    if "patch" not in patch.name or patch.value >= patch.threshold:
        return ""
    return f"; the dent under the patch is not resolved: refine the mesh there {patch.threshold / patch.value:.2g} times to see it"
