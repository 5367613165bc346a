"""How a load changes with time."""

from dataclasses import dataclass

import numpy as np
from scipy.integrate import trapezoid

from sdfnet.errors import ConfigurationError


@dataclass(frozen=True)
class History:
    """A factor on a load: straight lines between the given times, constant before the first and after the last."""

    times: tuple[float, ...] = (0.0,)  # s, rising
    values: tuple[float, ...] = (1.0,)

    def __post_init__(self) -> None:
        if len(self.times) != len(self.values) or not self.times:
            raise ConfigurationError(f"history.times and history.values must be equally many and not empty, found {len(self.times)} and {len(self.values)}")
        if not (np.isfinite(self.times).all() and np.isfinite(self.values).all()) or (np.diff(self.times) <= 0).any():
            raise ConfigurationError(f"history.times must rise and all numbers be finite, found times {self.times} and values {self.values}")

    @property
    def is_constant(self) -> bool:
        """Whether the factor never changes."""
        return len(set(self.values)) == 1

    def factor(self, time: float) -> float:
        """The factor at a time (s)."""
        return float(np.interp(time, self.times, self.values))

    def missed_share(self, time_step: float, duration: float) -> float:
        """How much of the load steps of a length (s) pass over until `duration` (s): integral of |factor - lines between its values at the steps| / |factor|.

        Only steps with a bend of the history within can miss anything.
        """
        bends = np.asarray(self.times)[(np.asarray(self.times) > 0) & (np.asarray(self.times) < duration)]
        first = np.floor(bends / time_step)
        seen = np.minimum(np.unique([0.0, *first, *(first + 1), np.inf]) * time_step, duration)
        all_times = np.union1d(seen, bends)
        factors, between = np.interp(all_times, self.times, self.values), np.interp(all_times, seen, np.interp(seen, self.times, self.values))
        whole = float(trapezoid(np.abs(factors), all_times))
        return float(trapezoid(np.abs(factors - between), all_times)) / whole if whole > 0 else 0.0


CONSTANT = History()


def ramp(rise: float) -> History:
    """From nothing to full strength in `rise` seconds, and full from there."""
    return History((0.0, rise), (0.0, 1.0))


def pulse(start: float, end: float) -> History:
    """A half sine from `start` to `end` (s), nothing before and after; 64 straight lines, which miss it by 3e-4 at most."""
    phases = np.linspace(0.0, 1.0, 65)
    return History(tuple((start + (end - start) * phases).tolist()), tuple((np.sin(np.pi * phases) * (phases < 1)).tolist()))
