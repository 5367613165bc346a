"""The Pareto front, its knee and the cheapest combination, against counting and closed forms."""

import itertools
import math

import numpy as np
import pytest

from sdfnet.cost.frontier import cheapest, factor_per_digit, knee, pareto_front


def random_pairs(count: int, seed: int) -> list[tuple[float, float]]:
    return [tuple(pair) for pair in np.exp(np.random.default_rng(seed).normal(size=(count, 2))).tolist()]


@pytest.mark.parametrize("seed", range(5))
def test_front_holds_exactly_the_pairs_that_none_dominates(seed: int) -> None:
    pairs = random_pairs(60, seed)
    undominated = {
        place
        for place, (error, seconds) in enumerate(pairs)
        if not any(other[0] <= error and other[1] <= seconds and other != (error, seconds) for other in pairs)
    }
    front = pareto_front(pairs)
    assert set(front) == undominated
    assert [pairs[place][0] for place in front] == sorted(pairs[place][0] for place in front)


def test_front_keeps_one_of_equal_pairs_and_none_that_is_not_finite() -> None:
    assert pareto_front([(1.0, math.nan), (2.0, 1.0), (2.0, 1.0), (math.inf, 0.0)]) == [1]
    assert pareto_front([]) == []


def test_knee_is_the_corner_of_an_l_shaped_front() -> None:
    assert knee([(1.0, 1000.0), (1.1, 30.0), (1.2, 3.0), (30.0, 2.0), (1000.0, 1.0)]) == 2


def test_straight_or_short_fronts_have_no_knee() -> None:
    assert knee([(1.0, 2.0), (2.0, 1.0)]) is None
    assert knee([(error, 3 * error**-0.5) for error in np.logspace(-4, 0, 9)]) is None, "rounding bends a power law by 1e-16"
    bulging = [(1.0, 1000.0), (900.0, 900.0), (1000.0, 1.0)]
    assert knee(bulging) is None


def test_factor_per_digit_are_those_of_a_power_law() -> None:
    errors = np.logspace(-4, 0, 9)
    assert factor_per_digit([(error, 3 * error**-0.5) for error in errors]) == pytest.approx(math.sqrt(10), rel=1e-12)
    assert factor_per_digit([(1.0, 1.0)]) is None
    assert factor_per_digit([(1.0, 1.0), (0.9, 5.0)]) is None  # a tenth would be a guess


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("allowed_error", [0.5, 1.5, 4.0])
def test_cheapest_combination_is_the_one_that_trying_all_finds(seed: int, allowed_error: float) -> None:
    stages = [random_pairs(7, 10 * seed + stage) for stage in range(3)]
    sums = [
        (sum(stage[place][1] for stage, place in zip(stages, places, strict=True)), places)
        for places in itertools.product(range(7), repeat=3)
        if sum(stage[place][0] for stage, place in zip(stages, places, strict=True)) <= allowed_error
    ]
    found = cheapest(stages, allowed_error)
    if not sums:
        assert found is None
    else:
        assert found is not None
        assert sum(stage[place][1] for stage, place in zip(stages, found, strict=True)) == pytest.approx(min(sums)[0], rel=1e-12)
