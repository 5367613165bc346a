"""Values on a grid only where the surface may be: blocks of cells are left out by a Lipschitz bound, then points between others."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float32, Int64

from sdfnet.errors import ConfigurationError
from sdfnet.evaluation.reconstruct import Grid, extent
from sdfnet.geometry.distance import SurfaceDistance

# Cells along an edge of a block, coarse to fine. Blocks of the first two sizes are asked for at their centres, which are
# points of the grid, those of two cells at their corners.
BLOCKS = (8, 4, 2)
EXACT = (1.0, 1.0, 1.0)  # a true distance changes by at most one metre a metre, in blocks of every size
ROUNDING = 1e-4  # part of the bound added to it, for values rounded to float32
EVERY_SECOND = (slice(None, None, 2),) * 3

Ask = Callable[[Int64[np.ndarray, " points"]], Float32[np.ndarray, " points"]]


@dataclass(frozen=True, eq=False)
class SparseValues:
    """A field on a block of a grid's points, positive beyond it: its own values where its surface may be, values of the right sign elsewhere."""

    values: Float32[np.ndarray, "x y z"]  # m
    start: tuple[int, int, int]  # place in the grid of the block's first point
    asked: int  # at how many points the field was evaluated


def sparse_values(ask: Ask, grid: Grid, slopes: tuple[float, ...] = EXACT) -> SparseValues:
    """Values (m) of a field where its surface may be. `ask` is given flat indices of grid points, z running fastest.

    A block whose centre c has |f(c)| > L r, r being half its diagonal, has one sign. Blocks of 8^3 cells nearer than that
    are split; in blocks of 4^3 cells nearer than that every second point is asked for. A point between those is
    predicted: the mean p of its 2, 4 or 8 neighbours among them, each d away. Where |p| > L d it has the sign of p,
    elsewhere it is asked for, and so is each end of an edge along which the sign changes: marching cubes looks at these
    values and at no others. `slopes` holds L for each size of BLOCKS: one for a true distance, `measured_slopes` for a
    network. Marching cubes finds the same triangles as in values of the whole grid as long as L holds; where it does
    not, a piece of the surface is still found whole if any of its edges is. Values that are not finite are never left
    out. Raises ConfigurationError when the slopes are not one positive number a size.
    Not for a field that jumps, such as KNN-1, and not for measuring it: far values are those of block centres.
    """
    if len(slopes) != len(BLOCKS) or not all(slope > 0 for slope in slopes):
        raise ConfigurationError(f"sparse values need a positive slope for each block size {BLOCKS}, found {slopes}")
    bounds = [(slope + ROUNDING) * size * float(np.linalg.norm(grid.spacing)) / 2 for slope, size in zip(slopes, BLOCKS, strict=True)]
    coarse = _every_second(ask, grid, bounds)
    everywhere = np.ones(coarse.values.shape, bool)
    may_be_inside = (coarse.values < 0) | _is_near(coarse.values, bounds[2])
    for is_kept in (may_be_inside if may_be_inside.any() else everywhere, everywhere):
        block = _block_about(coarse, is_kept, slopes[2])
        if not block.is_left():  # where L does not hold, the surface may leave the block; it never leaves the grid
            break
    return SparseValues(block.values, block.start, block.asked)


def exact_values(distance: SurfaceDistance, grid: Grid) -> SparseValues:
    """The exact signed distance where marching cubes looks at it. Marching these values gives the floor: what the grid itself costs, with no network."""
    return sparse_values(lambda indices: distance.signed_distance(grid.points_at(indices)).numpy(), grid)


def predicted_between(values: Float32[np.ndarray, "half_x half_y half_z"], shape: tuple[int, int, int]) -> Float32[np.ndarray, "x y z"]:
    """Values at the points of a block of this shape from those at every second: themselves, or the mean of the 2, 4 or 8 that are nearest."""
    with np.errstate(invalid="ignore", over="ignore"):  # who marches the values refuses those that are not finite
        for axis in (2, 1, 0):  # the last axis first, while the array is small: the others are added row by row
            known = np.moveaxis(values, axis, 0)
            values = np.empty((*values.shape[:axis], shape[axis], *values.shape[axis + 1 :]), np.float32)
            filled, last = np.moveaxis(values, axis, 0), 2 * len(known) - 2
            filled[::2] = known
            filled[1:last:2] = np.float32(0.5) * (known[:-1] + known[1:])
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
        self.ask, self.grid, self.start, self.step = ask, grid, start, step
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

    def is_left(self) -> bool:
        """Whether the field is negative on a face of the block that is not one of the grid's."""
        for axis, (first, count) in enumerate(zip(self.start, self.values.shape, strict=True)):
            inner = [0] * (first > 0) + [-1] * (first + count < self.grid.resolution)
            if (self.values.take(inner, axis) < 0).any():
                return True
        return False


def _every_second(ask: Ask, grid: Grid, bounds: list[float]) -> _Points:
    """Every second point of the grid, asked for where `bounds` for 8 and 4 cells leave the blocks in."""
    shape = ((grid.resolution + 1) // 2,) * 3
    points = _Points(ask, grid, (0, 0, 0), 2, np.zeros(shape, np.float32))
    values, is_near = np.zeros((1, 1, 1), np.float32), np.ones((1, 1, 1), bool)
    for size, bound in zip(BLOCKS[:2], bounds[:2], strict=True):
        blocks = -(-(grid.resolution - 1) // size)
        # The last block may reach beyond the box: the last point is no further from any of its cells than the centre would be.
        centres = np.ix_(*[np.minimum((np.arange(blocks) * size + size // 2) // 2, shape[0] - 1)] * 3)
        values, is_near, is_wanted = _split(values, blocks), _split(is_near, blocks), np.zeros(shape, bool)
        is_wanted[centres] = is_near
        points.require_all(is_wanted)
        values = np.where(is_near, points.values[centres], values)
        is_near &= _is_near(values, bound)
    points.require_all(_points_of(is_near, shape[0]))
    points.values = np.where(points.is_asked, points.values, _split(values, shape[0]))
    return points


def _block_about(coarse: _Points, is_kept: Bool[np.ndarray, "x y z"], slope: float) -> _Points:
    """All points about those of every second that are kept, asked for wherever the surface may be."""
    first, last = extent(is_kept)
    first, last = np.maximum(first - 1, 0), np.minimum(last + 1, len(is_kept) - 1)
    inner = tuple(slice(low, high + 1) for low, high in zip(first, last, strict=True))
    columns, rows, planes = (np.minimum(2 * last + 2, coarse.grid.resolution) - 2 * first)[::-1].tolist()
    predicted = predicted_between(coarse.values[inner], (planes, rows, columns))
    x, y, z = (2 * first).tolist()
    block = _Points(coarse.ask, coarse.grid, (x, y, z), 1, predicted, coarse.asked)
    block.is_asked[EVERY_SECOND] = coarse.is_asked[inner]
    is_close = ~(np.abs(predicted) > np.float32(slope + ROUNDING) * reach_between(coarse.grid, (planes, rows, columns)))
    turned = block.require_all(is_close | ends_of_cut_edges(predicted < 0))
    steps = np.array([1, -1, columns, -columns, rows * columns, -rows * columns])
    values, is_asked = block.values.reshape(-1), block.is_asked.reshape(-1)
    while len(turned):
        # Edges that were not thought to be cut: their other ends. After the last point of a row comes the next row's first, which is one too many at most.
        beside = (turned[:, None] + steps).clip(0, len(values) - 1)
        is_end = (values[beside] < 0) != (values[turned] < 0)[:, None]
        turned = block.require(np.unique(beside[is_end & ~is_asked[beside]]))
    return block


def _is_near(values: Float32[np.ndarray, "x y z"], bound: float) -> Bool[np.ndarray, "x y z"]:
    """Whether there may be surface as near as `bound` says, or a value that is not finite."""
    height = np.abs(values)
    return ~((height > bound) & (height < np.inf))


def _split(blocks: np.ndarray, count: int) -> np.ndarray:
    """What each block says, said by the blocks of half its size, so many along each axis; those beyond the last say what it says."""
    whole = np.minimum(np.arange(count) // 2, len(blocks) - 1)
    for axis in (2, 1, 0):  # the last axis first, while the array is small: the others are copied row by row
        blocks = blocks.take(whole, axis)
    return blocks


def _points_of(blocks: Bool[np.ndarray, "x y z"], count: int) -> Bool[np.ndarray, "points points points"]:
    """Which points, so many along each axis, lie in a block of two cells or on its boundary."""
    below, above = (np.arange(count) - 1).clip(0) // 2, np.minimum(np.arange(count) // 2, len(blocks) - 1)
    for axis in (2, 1, 0):
        blocks = blocks.take(below, axis) | blocks.take(above, axis)
    return blocks
