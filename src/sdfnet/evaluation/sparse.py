"""Values on a grid only where the surface may be: coarse to fine, each point first predicted from the coarser points about it."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Int64

from sdfnet.errors import ConfigurationError
from sdfnet.evaluation.reconstruct import Grid, extent
from sdfnet.geometry.distance import SurfaceDistance

STEPS = (4, 2, 1)  # cells between the points of each level but the coarsest
COARSEST = 2 * STEPS[0]  # cells between the points that are all asked for
EXACT = (1.0, 1.0, 1.0)  # a true distance changes by at most one metre a metre, at every level
ROUNDING = 1e-4  # added to every slope, for values rounded to float32
EVERY_SECOND = (slice(None, None, 2),) * 3

Ask = Callable[[Int64[np.ndarray, " points"]], Float32[np.ndarray, " points"]]


@dataclass(frozen=True, eq=False)
class SparseValues:
    """A field on a block of a grid's points, positive beyond it: its own values where its surface may be, values of the right sign elsewhere."""

    values: Float32[np.ndarray, "x y z"]  # m
    start: tuple[int, int, int]  # place in the grid of the block's first point
    asked: int  # how many values of the field were evaluated


def _mean(first: Float32[np.ndarray, "x y z"], second: Float32[np.ndarray, "x y z"]) -> Float32[np.ndarray, "x y z"]:
    return np.float32(0.5) * (first + second)


def sparse_values(ask: Ask, grid: Grid, slopes: tuple[float, ...] = EXACT) -> SparseValues:
    """Values (m) of a field where its surface may be. `ask` is given flat indices of grid points, z running fastest.

    Every eighth point along each axis is asked for, then those at every fourth, every second and all. A point of a finer
    level is predicted first: the mean p of its 1, 2, 4 or 8 neighbours of the coarser one, each d away. Where |p| > L d it
    has the sign of p and is no nearer to zero than the neighbour farthest from it less L d, which the next level takes
    for its value; elsewhere it is asked for. At the finest level so is each end of an edge along which the sign changes:
    marching cubes looks at these values and at no others. `slopes` holds L for each of STEPS: one for a true distance,
    `measured_slopes` for a network. Marching cubes finds the same triangles as in values of the whole grid as long as L holds; where it does not,
    a piece of the surface is still found whole if any of its edges is. Values that are found not to be finite are kept.
    Raises ConfigurationError when the slopes are not one positive, finite number a level.
    Not for a field that jumps, such as KNN-1, and not for measuring it: far values have the right side, and no more.
    """
    if len(slopes) != len(STEPS) or not all(0 < slope < math.inf for slope in slopes):
        raise ConfigurationError(f"sparse values need a positive, finite slope for each of the levels with points every {STEPS} cells, found {slopes}")
    shape = (-(-grid.resolution // COARSEST),) * 3
    points = _Points(ask, grid, (0, 0, 0), COARSEST, np.zeros(shape, np.float32))
    points.require_all(np.ones(shape, bool))
    for slope in slopes[:-1]:
        points = _finer(points, slope)
    block = _finer(_about_surface(points, slopes[-1]), slopes[-1])
    if block.is_left():  # where L does not hold, the surface may leave the block; it never leaves the grid
        points.asked = block.asked
        block = _finer(points, slopes[-1])
    return SparseValues(block.values, block.start, block.asked)


def exact_values(distance: SurfaceDistance, grid: Grid) -> SparseValues:
    """The exact signed distance where marching cubes looks at it. Marching these values gives the floor: what the grid itself costs, with no network."""
    return sparse_values(lambda indices: distance.signed_distance(grid.points_at(indices)).numpy(), grid)


def predicted_between(
    values: Float32[np.ndarray, "half_x half_y half_z"], shape: tuple[int, int, int], of_two: Callable[[np.ndarray, np.ndarray], np.ndarray] = _mean
) -> Float32[np.ndarray, "x y z"]:
    """Values at the points of a block of this shape from those at every second: themselves, or the mean of the 1, 2, 4 or 8 that are nearest.

    The mean of 4 is that of two means of two; `of_two` takes its place.
    """
    with np.errstate(invalid="ignore", over="ignore"):  # who marches the values refuses those that are not finite
        for axis in (2, 1, 0):  # the last axis first, while the array is small: the others are added row by row
            known = np.moveaxis(values, axis, 0)
            values = np.empty((*values.shape[:axis], shape[axis], *values.shape[axis + 1 :]), np.float32)
            filled, last = np.moveaxis(values, axis, 0), 2 * len(known) - 2
            filled[::2] = known
            filled[1:last:2] = of_two(known[:-1], known[1:])
            filled[last + 1 :] = known[-1]
    return values


def reach_between(grid: Grid, shape: tuple[int, int, int]) -> Float32[np.ndarray, "x y z"]:
    """How far (m) each point of a block lies from those that `predicted_between` takes the mean of; 0 for every second point."""
    x, y, z = (np.where(np.arange(count) % 2, spacing**2, 0.0).astype(np.float32) for count, spacing in zip(shape, grid.spacing, strict=True))
    even_and_odd = np.sqrt(x[:2, None, None] + (y[:, None] + z))
    return even_and_odd.take(np.arange(shape[0]) % 2, axis=0)


def ends_of_cut_edges(is_inside: Bool[np.ndarray, "x y z"]) -> Bool[np.ndarray, "x y z"]:
    """The points that a neighbour on the other side of the surface has; the last point of a row is taken for a neighbour of the next row's first."""
    inside, is_end = is_inside.reshape(-1), np.zeros(is_inside.size, bool)
    for step in (1, is_inside.shape[2], is_inside.shape[1] * is_inside.shape[2]):
        differs = inside[step:] != inside[:-step]
        is_end[step:] |= differs
        is_end[:-step] |= differs
    return is_end.reshape(is_inside.shape)


class _Points:
    """Every `step`-th point of a block of a grid, and what the field is known or thought to be there."""

    def __init__(self, ask: Ask, grid: Grid, start: tuple[int, int, int], step: int, values: Float32[np.ndarray, "x y z"], asked: int = 0) -> None:
        self.ask, self.grid, self.start, self.step = ask, grid, start, step  # start: place in the grid of the first point
        self.values, self.is_asked, self.asked = values, np.zeros(values.shape, bool), asked

    def require(self, places: Int64[np.ndarray, " points"]) -> Int64[np.ndarray, " turned"]:
        """Ask at these flat places, not asked at before; those that are not on the side of the surface that they were thought to be."""
        if not len(places):
            return places
        (_, rows, columns), along = self.values.shape, self.grid.resolution
        row = places // columns  # by hand: numpy's unravel_index and ravel_multi_index take five times as long
        x = row // rows
        indices = self.step * ((x * along + row - rows * x) * along + places - columns * row) + np.ravel_multi_index(self.start, self.grid.shape)
        values, found = self.values.reshape(-1), self.ask(indices)
        has_turned = (found < 0) != (values[places] < 0)
        values[places], self.is_asked.reshape(-1)[places] = found, True
        self.asked += len(places)
        return places[has_turned]

    def require_all(self, is_wanted: Bool[np.ndarray, "x y z"]) -> Int64[np.ndarray, " turned"]:
        """`require` what is wanted and was not asked for."""
        return self.require(np.flatnonzero(is_wanted & ~self.is_asked))

    def follow(self, turned: Int64[np.ndarray, " points"]) -> None:
        """`require` the other ends of edges that were not thought to be cut, about points that have turned, and about those that turn then."""
        _, rows, columns = self.values.shape
        steps = np.array([1, -1, columns, -columns, rows * columns, -rows * columns])
        values, is_asked = self.values.reshape(-1), self.is_asked.reshape(-1)
        while len(turned):  # after the last point of a row comes the next row's first, which is one too many at most
            beside = (turned[:, None] + steps).clip(0, len(values) - 1)
            is_end = (values[beside] < 0) != (values[turned] < 0)[:, None]
            turned = self.require(np.unique(beside[is_end & ~is_asked[beside]]))

    def is_left(self) -> bool:
        """Whether the field is negative on a face of the block that is not one of the grid's; for a block of all points, step 1."""
        for axis, (first, count) in enumerate(zip(self.start, self.values.shape, strict=True)):
            inner = [0] * (first > 0) + [-1] * (first + count < self.grid.resolution)
            if (self.values.take(inner, axis) < 0).any():
                return True
        return False


def _finer(coarse: _Points, slope: float) -> _Points:
    """All points of the next level between and about these, asked for wherever the surface may be."""
    step = coarse.step // 2
    known = [2 * count for count in coarse.values.shape]
    left = [-(-(coarse.grid.resolution - first) // step) for first in coarse.start]
    shape = tuple(map(min, known, left))
    predicted, rise = predicted_between(coarse.values, shape), np.float32(step * (slope + ROUNDING)) * reach_between(coarse.grid, shape)
    is_close = ~(np.abs(predicted) > rise)
    points = _Points(coarse.ask, coarse.grid, coarse.start, step, predicted, coarse.asked)
    points.is_asked[EVERY_SECOND] = coarse.is_asked
    if step > 1:  # the next level predicts from these
        points.values = np.copysign(predicted_between(np.abs(coarse.values), shape, np.maximum) - rise, predicted)
        points.require_all(is_close)
    else:
        points.follow(points.require_all(is_close | ends_of_cut_edges(predicted < 0)))
    return points


def _about_surface(points: _Points, slope: float) -> _Points:
    """The block of these points outside which the next level finds none inside; all of them where it finds none anywhere."""
    bound = (slope + ROUNDING) * points.step / 2 * float(np.linalg.norm(points.grid.spacing))
    is_kept = ~((points.values > bound) & (points.values < np.inf))
    if not is_kept.any():
        return points
    first, last = extent(is_kept)
    first, last = np.maximum(first - 1, 0), np.minimum(last + 1, len(is_kept) - 1)
    inner = tuple(slice(low, high + 1) for low, high in zip(first, last, strict=True))
    x, y, z = (points.step * first).tolist()
    block = _Points(points.ask, points.grid, (x, y, z), points.step, points.values[inner], points.asked)
    block.is_asked = points.is_asked[inner]
    return block
