"""What advice is, and the words in which it is given."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from sdfnet.physics.advice.numbers import Number
from sdfnet.physics.plan import Plan

CALLED_FOR, LEFT_OUT, NEEDED, COULD_GO = "called for", "can be left out", "present and needed", "present, could go"
IF_THERE = "if there is one"  # of a floor that the scene does not name
SUFFICES, ANOTHER, CHEAPER = "suffices", "another called for", "a cheaper would do"  # of the element, which no scene can be without
UNMEASURED = 1.0  # a change of finite strain beyond it is not told as a number: there the trial has lost count (predicted 196 %, found 1,610 %)


@dataclass(frozen=True)
class Advice:
    """What one number of a scene says for or against an effect. All numbers of an effect share verdict, change and cost."""

    effect: str  # its registry name, or element, or inertia
    number: str  # name and formula
    value: float
    threshold: float  # beyond it the number by itself speaks for the effect
    verdict: str  # one of the words above
    predicted_change: float  # of the displacements, in the mass norm over all frames, if it were added or taken away; infinite or NaN where no trial can tell
    cost: str
    sentence: str  # what to do

    @property
    def change(self) -> str:
        """The predicted change for the screen."""
        return percent(self.predicted_change, self.effect)


def rows_of(effect: str, numbers: Sequence[Number], verdict: str, change: float, cost: str, sentence: str) -> list[Advice]:
    """One for each number."""
    return [Advice(effect, number.name, number.value, number.threshold, verdict, change, cost, sentence) for number in numbers]


def verdict_on(is_present: bool, is_needed: bool) -> str:
    """Of an effect that a scene may have or not."""
    return (NEEDED if is_needed else COULD_GO) if is_present else (CALLED_FOR if is_needed else LEFT_OUT)


def what_to_do(verdict: str, what: str, change: str) -> str:
    """About such an effect."""
    words = {
        CALLED_FOR: f"add {what}: it would change",
        LEFT_OUT: f"leave {what} out: it would change",
        NEEDED: f"keep {what}: to go without it would change",
        COULD_GO: f"{what} could go: to go without it would change",
    }
    return f"{words[verdict]} the displacements by {change}"


def one_by_one(compiled: Plan, verdict: str) -> str:
    """What load cases must do for an effect that they do not know."""
    return "; simulate the load cases one by one then" if compiled.scene.load_cases and verdict in (CALLED_FOR, IF_THERE) else ""


def percent(change: float, effect: str = "") -> str:
    """A change in words; of `finite_strain` beyond `UNMEASURED` only that it is."""
    if math.isnan(change):
        return "unknown"
    if effect == "finite_strain" and change > UNMEASURED:
        return f"over {100 * UNMEASURED:.0f} %"
    return "no bound" if math.isinf(change) else f"{100 * change:.2g} %" if change < 1 else f"{100 * change:.0f} %"
