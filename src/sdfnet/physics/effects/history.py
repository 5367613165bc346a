"""How a load changes with time."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float64

from sdfnet.checked import Checked
from sdfnet.errors import ConfigurationError


@dataclass(frozen=True)
class History(Checked):
    """A factor on a load: straight lines between the given times, constant before the first and after the last."""

    times: tuple[float, ...] = (0.0,)  # s, rising
    values: tuple[float, ...] = (1.0,)

    def __post_init__(self) -> None:
        super().__post_init__()
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
        return float(np.interp(time, *self._table))

    def mean(self, start: float, end: float) -> float:
        """The mean factor between two times (s), exactly: what a step of that length takes, so that no impulse is lost."""
        cuts = np.array([start, *self.bends(start, end), end])
        factors = np.interp(cuts, *self._table)
        return float(np.diff(cuts) / (end - start) @ (factors[1:] + factors[:-1])) / 2

    def means(self, ends: Float64[np.ndarray, " ends"]) -> Float64[np.ndarray, " steps"]:
        """The same for each step between rising times (s). Where nothing bends it is the factor in the middle."""
        result = np.interp((ends[1:] + ends[:-1]) / 2, *self._table)
        within = np.setdiff1d(self.bends(ends[0], ends[-1]), ends)  # at an end: else rounding would tell how many steps are asked for at once
        for step in np.unique(np.searchsorted(ends, within) - 1):
            result[step] = self.mean(ends[step], ends[step + 1])
        return result

    def bends(self, start: float, end: float) -> Float64[np.ndarray, " bends"]:
        """The times of the table strictly between two times (s)."""
        times = self._table[0]
        return times[np.searchsorted(times, start, side="right") : np.searchsorted(times, end, side="left")]

    def largest_miss(self, time_step: float, duration: float) -> float:
        """How far lines between the factors at the steps come from the factor at worst until `duration` (s), over the largest factor.

        Over one bend that is at most the change of slope times a quarter of the step (s). It is measured where the factor
        bends, so a short blow counts as much in a long run as in a short one.
        """
        bends = self.bends(0.0, duration)
        first = np.floor(bends / time_step)
        seen = np.minimum(np.unique([0.0, *first, *(first + 1), np.inf]) * time_step, duration)
        factors, between = np.interp(bends, *self._table), np.interp(bends, seen, np.interp(seen, *self._table))
        largest = float(np.abs([*factors, self.factor(0.0), self.factor(duration)]).max())
        return float(np.abs(factors - between).max(initial=0.0)) / largest if largest > 0 else 0.0

    @cached_property
    def _table(self) -> tuple[Float64[np.ndarray, " times"], Float64[np.ndarray, " times"]]:
        return np.array(self.times, dtype=np.float64), np.array(self.values, dtype=np.float64)


CONSTANT = History()


def ramp(rise: float) -> History:
    """From nothing to full strength in `rise` seconds, and full from there."""
    return History((0.0, rise), (0.0, 1.0))


def pulse(start: float, end: float) -> History:
    """A half sine from `start` to `end` (s), nothing before and after; 64 straight lines, which miss it by 3e-4 at most."""
    phases = np.linspace(0.0, 1.0, 65)
    return History(tuple((start + (end - start) * phases).tolist()), tuple((np.sin(np.pi * phases) * (phases < 1)).tolist()))
