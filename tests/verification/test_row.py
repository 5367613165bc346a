"""What passes and what does not, and the numbers that rows are made of."""

import math

import numpy as np
import pytest

from sdfnet.verification.row import absolute, between, deviation, fitted_order, relative


def test_a_relative_error_is_a_part_of_the_exact_value() -> None:
    assert relative("", "", 4.0, 4.1, 0.026).passes
    assert not relative("", "", 4.0, 4.1, 0.024).passes
    assert not relative("", "", -4.0, 4.0, 1.9).passes


def test_an_absolute_error_is_a_difference() -> None:
    assert absolute("", "", 2.0, 1.85, 0.2).passes
    assert not absolute("", "", 2.0, 1.75, 0.2).passes
    assert absolute("", "", 0.0, 1e-13, 1e-12).passes


@pytest.mark.parametrize(("found", "passes"), [(0.74, False), (0.75, True), (0.83, True), (0.84, False), (1.0, False), (math.nan, False)])
def test_an_element_that_is_known_to_fail_must_fail_as_expected(found: float, passes: bool) -> None:
    row = between("", "", 1.0, found, (0.75, 0.83))
    assert row.passes is passes
    assert row.criterion == "0.75 to 0.83"


@pytest.mark.parametrize("found", [math.nan, math.inf])
def test_what_is_not_finite_never_passes(found: float) -> None:
    assert not relative("", "", 1.0, found, 1e9).passes
    assert not absolute("", "", 0.0, found, 1e9).passes
    assert not absolute("", "", 0.0, deviation(np.array([0.0, math.nan]), np.array([0.0, 1.0])), 1e9).passes


def test_a_deviation_is_the_largest_difference_over_the_largest_exact_value() -> None:
    assert deviation(np.array([1.0, 2.0, -8.5]), np.array([1.0, 2.5, -8.0])) == 0.5 / 8


def test_the_order_is_fitted_to_all_points() -> None:
    sizes = [1.0, 0.5, 0.25, 0.125]
    assert fitted_order(sizes, [3 * size**2 for size in sizes]) == pytest.approx(2, abs=1e-12)
    assert fitted_order(sizes, [1.0, 0.25, 0.0625, 0.0625]) == pytest.approx(1.4, abs=1e-12)  # stagnates: sum of (x - 1.5)(y) / 5 with y = 0, 2, 4, 4
