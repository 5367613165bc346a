"""What one stage costs at each accuracy: measured points, and how they are timed."""

import math
import statistics
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

SECONDS, BYTES = "seconds", "bytes"  # what a cost may be, besides the counts that a study names
LEAST_SECONDS = 0.05  # that a timing of something short takes, in as many calls as it needs: a first one finds a cache that others have filled
EXACT_MM = 1e-9  # stands for an error of zero, which no logarithm shows: a millionth of a micrometre


@dataclass(frozen=True)
class Timing:
    """Seconds of repeats of one thing."""

    median: float
    p5: float  # 5th and 95th percentile over the repeats
    p95: float
    repeats: int

    @classmethod
    def of(cls, seconds: list[float]) -> "Timing":
        """The timing of repeats, or of a single run, whose spread is not known and shown as none."""
        return cls(statistics.median(seconds), float(np.quantile(seconds, 0.05)), float(np.quantile(seconds, 0.95)), len(seconds))

    def divided_by(self, count: int | float) -> "Timing":
        """The time of one of `count` equal parts; for a count below one, which is a share, of the whole that it is a share of."""
        return Timing(self.median / count, self.p5 / count, self.p95 / count, self.repeats)


@dataclass(frozen=True)
class Point:
    """One configuration of a stage: how wrong it is and what it costs, or why it could not be measured."""

    method: str  # the series that it belongs to: "leapfrog, lumped mass"
    setting: str  # what is varied along the series: "step 1.7e-06 s"
    error_mm: float | None = None
    seconds: Timing | None = None
    counts: Mapping[str, int] = field(default_factory=dict)  # the noise-free companion of seconds: products, queries, points
    bytes: int | None = None  # to keep in order to answer, where that is a question
    is_default: bool = False  # what a user gets without asking
    overrides: tuple[str, ...] = ()  # that make the commands do it; empty for a baseline
    failure: str | None = None  # a point that failed keeps its place, with the reason
    is_reference: bool = False  # what the others are measured against: no error by construction, so it is on no front and in no fit
    cost: str = SECONDS  # what its cost is: SECONDS, BYTES or one of the counts

    @property
    def pair(self) -> tuple[float, float]:
        """Error (mm) and cost, of seconds the median, for logarithmic axes; no error as EXACT_MM; nan of a point that failed."""
        seconds = None if self.seconds is None else self.seconds.median
        cost = {**self.counts, BYTES: self.bytes, SECONDS: seconds}.get(self.cost)
        if self.failure is not None or self.error_mm is None or cost is None:
            return math.nan, math.nan
        return max(self.error_mm, EXACT_MM), float(cost)

    @property
    def is_measured(self) -> bool:
        """Whether it has an error and a cost, and can stand in a plot."""
        return math.isfinite(sum(self.pair))

    def words(self) -> str:
        """Method, setting, error and cost of a measured point."""
        error, cost = self.pair
        texts = {SECONDS: duration_text, BYTES: size_text}
        shown = texts[self.cost](cost) if self.cost in texts else f"{cost:,.0f} {self.cost}"
        return f"{self.method}, {self.setting} ({error:.3g} mm, {shown})"


@dataclass(frozen=True)
class Study:
    """One diagram of error against time."""

    name: str  # file name and anchor: simulation_time
    title: str
    error_label: str  # what the error is measured against: "RMS displacement error against the exact-in-time solution (mm)"
    cost_label: str  # what the seconds or bytes are of: "for 10 ms of motion (s)"
    points: tuple[Point, ...]
    share_of_whole: float = 1.0  # part of this stage of a default run that the seconds are of: one frame of a hundred
    part: str = ""  # a sentence that says what was measured of how much, where it was not all
    notes: tuple[str, ...] = ()  # sentences that only the study itself can write: fitted orders, what a choice changes


def interleaved(tasks: Mapping[str, Callable[[], Any]], repeats: int, least_seconds: float = 0.0, warm_up: int = 1) -> dict[str, Timing]:
    """Time tasks in turns, so that a noisy moment of the machine falls on all of them; `warm_up` turns are not counted.

    In a turn a task is called until `least_seconds` have passed, and counts with the mean of its calls.
    """
    seconds: dict[str, list[float]] = {name: [] for name in tasks}
    for turn in range(warm_up + repeats):
        for name, task in tasks.items():
            began, calls, passed = time.perf_counter(), 0, 0.0
            while calls == 0 or passed < least_seconds:
                task()
                calls, passed = calls + 1, time.perf_counter() - began
            if turn >= warm_up:
                seconds[name].append(passed / calls)
    return {name: Timing.of(found) for name, found in seconds.items()}


def duration_text(seconds: float) -> str:
    """Seconds in the unit that suits them."""
    for unit, size in (("s", 1.0), ("ms", 1e-3), ("us", 1e-6)):
        if seconds >= size:
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds * 1e9:.3g} ns"


def size_text(size: float) -> str:
    """Bytes in the unit that suits them."""
    for unit, count in (("MB", 1e6), ("kB", 1e3)):
        if size >= count:
            return f"{size / count:.3g} {unit}"
    return f"{size:.0f} bytes"
