"""Which of many measured points are worth having: the Pareto front, its knee, and the cheapest combination of stages."""

import math
from collections.abc import Sequence

import numpy as np

Pair = tuple[float, float]  # two costs, smaller is better
SHALLOWEST = 0.01  # of the front's extent along both logarithmic axes: what bends less is straight but for the noise of its timings


def pareto_front(pairs: Sequence[Pair]) -> list[int]:
    """Places of the pairs that no other pair beats in one cost without losing in the other, sorted by the first cost.

    Of equal pairs the first is kept; pairs with a nan or an infinity are never on the front.
    """
    finite = [place for place, pair in enumerate(pairs) if all(math.isfinite(cost) for cost in pair)]
    front: list[int] = []
    for place in sorted(finite, key=lambda place: (*pairs[place], place)):
        if not front or pairs[place][1] < pairs[front[-1]][1]:
            front.append(place)
    return front


def knee(pairs: Sequence[Pair]) -> int | None:
    """The place of the front's point that lies furthest below the chord between its ends, both axes logarithmic.

    There one more digit of either cost becomes dearer than it was before (Satopaa et al. 2011). None for a front of fewer
    than three points or one that nowhere bends towards the origin by SHALLOWEST. Both costs must be positive.
    """
    front = pareto_front(pairs)
    if len(front) < 3:
        return None
    logs = np.log([pairs[place] for place in front])
    ends = logs[-1] - logs[0]
    unit = (logs - logs[0]) / ends  # 0 to 1 along both axes; the chord is the diagonal
    below = unit[:, 1] - unit[:, 0]  # the second axis falls, so `unit` runs ahead where a point lies below the chord
    best = int(below.argmax())
    return front[best] if below[best] > SHALLOWEST else None


def factor_per_digit(pairs: Sequence[Pair]) -> float | None:
    """How many times the second cost grows when the first falls to a tenth, fitted along the front; None for a front that spans less than half of that."""
    front = pareto_front(pairs)
    if len(front) < 2 or pairs[front[-1]][0] < math.sqrt(10) * pairs[front[0]][0]:
        return None
    errors, costs = np.log10([pairs[place] for place in front]).T
    return float(10 ** -np.polyfit(errors, costs, 1)[0])


def cheapest(stages: Sequence[Sequence[Pair]], allowed_error: float) -> list[int] | None:
    """One place in each stage such that the errors add up to at most `allowed_error` and the sum of seconds is smallest.

    Pairs are (error, seconds). Errors of stages are added, as if they all pointed the same way. None when no
    combination is accurate enough. Fronts are combined stage by stage, each time only the combinations on a front are kept:
    a combination that is beaten in both sums cannot become the best by what is added to it.
    """
    combined: list[tuple[Pair, list[int]]] = [((0.0, 0.0), [])]
    for stage in stages:
        grown = [
            ((error + stage[place][0], seconds + stage[place][1]), [*places, place]) for (error, seconds), places in combined for place in pareto_front(stage)
        ]
        combined = [grown[place] for place in pareto_front([pair for pair, _ in grown])]
    affordable = [(pair[1], places) for pair, places in combined if pair[0] <= allowed_error]
    return min(affordable)[1] if affordable else None
