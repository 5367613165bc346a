"""One line of the table of reference cases: what theory says, what this code finds, and how far apart they may be."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Row:
    """One number beside its exact value."""

    setup: str  # what it was measured on: element, material, mass, integrator
    quantity: str
    exact: float  # NaN where theory gives bounds alone
    found: float
    error: float
    tolerance: float  # the largest error that passes
    unit: str = ""  # of exact and found; empty for a plain number
    expected: tuple[float, float] | None = None  # in place of the tolerance: where `found` must lie, such as an element that is known to fail
    case: str = ""  # the name in `CASES`

    @property
    def passes(self) -> bool:
        """Whether the number is as near as it must be; never for what is not finite."""
        if self.expected is not None:
            return bool(self.expected[0] <= self.found <= self.expected[1])
        return bool(self.error <= self.tolerance)  # of NumPy's numbers too, whose verdict JSON does not know

    @property
    def criterion(self) -> str:
        """What `passes` asks for, in words."""
        return f"<= {self.tolerance:.2g}" if self.expected is None else f"{self.expected[0]:.3g} to {self.expected[1]:.3g}"


def relative(setup: str, quantity: str, exact: float, found: float, tolerance: float, unit: str = "") -> Row:
    """The error is |found - exact| / |exact|."""
    return Row(setup, quantity, exact, found, abs(found - exact) / abs(exact), tolerance, unit)


def absolute(setup: str, quantity: str, exact: float, found: float, tolerance: float, unit: str = "") -> Row:
    """The error is |found - exact|: for what should be zero, and for orders of convergence."""
    return Row(setup, quantity, exact, found, abs(found - exact), tolerance, unit)


def between(setup: str, quantity: str, exact: float, found: float, expected: tuple[float, float], unit: str = "") -> Row:
    """What must lie in an interval: an element that is known to fail must be seen to. `exact` is NaN where theory gives bounds alone."""
    return Row(setup, quantity, exact, found, abs(found - exact) / (abs(exact) or 1.0), float("nan"), unit, expected)


def deviation(found: np.ndarray, exact: np.ndarray) -> float:
    """The largest difference, over the largest exact value; NaN when any is."""
    return float(np.abs(found - exact).max() / np.abs(exact).max())


def fitted_order(sizes: list[float], errors: list[float]) -> float:
    """p of error = c size^p, by least squares on the logarithms."""
    return float(np.polyfit(np.log(sizes), np.log(errors), 1)[0])
