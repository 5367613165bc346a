"""Parts of space by which effects choose nodes and surface: half-space, box, ball, where a function says so, or a class of your own."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from jaxtyping import Bool, Float64

from sdfnet.checked import Checked, taken
from sdfnet.errors import ConfigurationError

ROUNDING = 1e-9  # of the solid's diagonal: a point this little out of a region was meant to lie in it
DOUBLINGS, BISECTIONS = 40, 40  # of the solid's extent, to find how far it is from a region: up to 1e12 of it, then to 1e-12 of that interval


@dataclass(frozen=True)
class Region(Checked, ABC):
    """A part of space at rest. Derive from it, add fields, and `contains` is any predicate: one that a dataset file and a command line can hold."""

    heeds_tolerance: ClassVar[bool] = False  # whether `contains` grows with the tolerance; one that does spares surface loads the faces far away

    @abstractmethod
    def contains(self, points: Float64[np.ndarray, "points 3"], tolerance: float = 0.0) -> Bool[np.ndarray, " points"]:
        """True for the points (m) that lie in it, or out of it by no more than `tolerance` (m)."""

    def may_reach(self, points: Float64[np.ndarray, "points 3"], distance: float) -> Bool[np.ndarray, " points"]:
        """False for the points (m) that are certainly more than `distance` (m) out of it."""
        return self.contains(points, distance) if self.heeds_tolerance else np.ones(len(points), dtype=np.bool_)

    def beside(self, points: Float64[np.ndarray, "points 3"]) -> str:
        """Itself, where the nodes of a solid (m) are, and how far the nearest is out of it: for messages that say that it misses them."""
        lower, upper = (tuple(float(f"{x:.4g}") for x in corner) for corner in (points.min(axis=0), points.max(axis=0)))
        distance = self._distance(points)
        nearest = f", its nearest node {distance:.3g} m away" if distance else ""
        return f"{self} and a solid from {lower} to {upper} m{nearest}"

    def _distance(self, points: Float64[np.ndarray, "points 3"]) -> float | None:
        """The smallest tolerance with which it contains one of the points, m; None when no tolerance helps, as with a predicate that knows none."""
        if self.contains(points).any():
            return 0.0
        inside, outside = float(np.ptp(points, axis=0).max()), 0.0
        for _ in range(DOUBLINGS):
            if self.contains(points, inside).any():
                break
            inside, outside = 2 * inside, inside
        else:
            return None
        for _ in range(BISECTIONS):
            middle = (inside + outside) / 2
            inside, outside = (middle, outside) if self.contains(points, middle).any() else (inside, middle)
        return inside


@dataclass(frozen=True)
class HalfSpace(Region):
    """On and behind a plane: (x - point) . normal <= 0."""

    heeds_tolerance: ClassVar[bool] = True
    point: tuple[float, float, float] = (0.0, 0.0, 0.0)  # m, on the plane
    normal: tuple[float, float, float] = (0.0, 0.0, 1.0)  # points out of it; its length does not matter

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (np.isfinite(self.normal).all() and np.any(self.normal)):
            raise ConfigurationError(f"region.normal must be finite and not zero, found {tuple(self.normal)}")
        if not np.isfinite(self.point).all():
            raise ConfigurationError(f"region.point must be finite, found {tuple(self.point)} m")

    def contains(self, points: Float64[np.ndarray, "points 3"], tolerance: float = 0.0) -> Bool[np.ndarray, " points"]:
        """Height over the plane at most `tolerance`."""
        normal = np.asarray(self.normal, dtype=np.float64)
        heights: np.ndarray = (points - np.asarray(self.point, dtype=np.float64)) @ (normal / np.linalg.norm(normal))
        return heights <= tolerance


@dataclass(frozen=True)
class BoxRegion(Region):
    """Between two corners, the faces included. Infinite corners are allowed; by default it is all of space."""

    heeds_tolerance: ClassVar[bool] = True
    lower: tuple[float, float, float] = (-np.inf, -np.inf, -np.inf)  # m
    upper: tuple[float, float, float] = (np.inf, np.inf, np.inf)  # m

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (np.asarray(self.lower) <= np.asarray(self.upper)).all():
            raise ConfigurationError(f"region.lower must not exceed region.upper, found {tuple(self.lower)} and {tuple(self.upper)}")

    def contains(self, points: Float64[np.ndarray, "points 3"], tolerance: float = 0.0) -> Bool[np.ndarray, " points"]:
        """Within both corners, grown by `tolerance`."""
        within: np.ndarray = (points >= np.asarray(self.lower) - tolerance) & (points <= np.asarray(self.upper) + tolerance)
        return np.all(within, axis=1)


@dataclass(frozen=True)
class Ball(Region):
    """Within a radius of a centre."""

    heeds_tolerance: ClassVar[bool] = True
    center: tuple[float, float, float] = (0.0, 0.0, 0.0)  # m
    radius: float = 1.0  # m

    def __post_init__(self) -> None:
        super().__post_init__()
        if not np.isfinite(self.center).all():
            raise ConfigurationError(f"region.center must be finite, found {tuple(self.center)} m")
        if not self.radius > 0:
            raise ConfigurationError(f"region.radius must be positive, found {self.radius} m")

    def contains(self, points: Float64[np.ndarray, "points 3"], tolerance: float = 0.0) -> Bool[np.ndarray, " points"]:
        """Distance to the centre at most the radius plus `tolerance`."""
        within: np.ndarray = np.linalg.norm(points - np.asarray(self.center, dtype=np.float64), axis=1) <= self.radius + tolerance
        return within


@dataclass(frozen=True)
class Where(Region):
    """Where a function of the rest positions (m) is true: `Pinned(Where(lambda points: np.hypot(points[:, 0], points[:, 1]) < 0.01))`.

    For scenes that are built in Python. Not for a dataset file, whose settings are written down and a function cannot be:
    derive from `Region` there. It knows no tolerance: ask for `< 1e-9`, not for `== 0`, where nodes may be off by rounding.
    """

    predicate: Callable[[Float64[np.ndarray, "points 3"]], Bool[np.ndarray, " points"]]

    def contains(self, points: Float64[np.ndarray, "points 3"], tolerance: float = 0.0) -> Bool[np.ndarray, " points"]:
        """What the function answers. Raises ConfigurationError unless that is true or false for each point."""
        answer = taken("the answer of a region's predicate", self.predicate(points), Bool[np.ndarray, " points"])
        if len(answer) != len(points):
            raise ConfigurationError(
                f"a region's predicate must answer for each of the {len(points)} points at once, found {len(answer)} answers; "
                "write it for an array of shape (points, 3), such as lambda points: points[:, 0] < 0.1"
            )
        result: np.ndarray = answer
        return result


REGIONS: dict[str, type[Region]] = {"half_space": HalfSpace, "box": BoxRegion, "ball": Ball}  # by the name that a command line gives them
