"""How fast a field rises from its surface, measured: what a sparse reconstruction must know of a network."""

import numpy as np
from jaxtyping import Bool, Float32
from scipy.ndimage import maximum_filter

from sdfnet.evaluation.reconstruct import Grid
from sdfnet.evaluation.sparse import BLOCKS, EVERY_SECOND, ends_of_cut_edges, predicted_between, reach_between

# Measured slopes are raised by this factor for what was not measured: the slopes of 11 frames of the poked bunny lay
# within 20 % of each other at each block size, and the last frame, always measured, had the largest of every size.
SAFETY = 1.1
# Before that, no slope is less than a true distance may have in blocks, and a quarter of it between points: what is
# predicted on the wrong side is nearly always found by following the surface. The bunny's network needs no more there.
LEAST = (1.0, 1.0, 0.25)


def measured_slopes(values: Float32[np.ndarray, "frames x y z"], grid: Grid) -> tuple[float, ...]:
    """For each size of BLOCKS the L to search other frames of the same field with: SAFETY times the largest that is found.

    In blocks that is |f(c)| / r, where c is the centre of a block of that size, wherever on the grid, that holds a part
    of the surface, and r half its diagonal; between points it is |p| / d of a point that is predicted on the wrong side
    and that following the surface from the other points does not reach. This is the Lipschitz constant between the
    surface and what is that far from it, which is what a search needs, and not the largest gradient: far from its surface
    a network may be as steep as it likes. The guarantee is that of the measurement: a frame in which the field rises
    faster than in all that were measured, and by more than SAFETY, can lose cells.
    """
    half_cell, largest = np.linalg.norm(grid.spacing) / 2, np.array(LEAST)
    for field in values:
        is_cut, height = cut_cells(field < 0), np.abs(field)
        # The window of an even size reaches one cell further down than up, as the cells of a block about its centre do.
        found = [height[maximum_filter(is_cut, size)].max(initial=0.0) / (size * half_cell) for size in BLOCKS[:2]]
        largest = np.maximum(largest, [*found, _slope_between(field, grid)])
    return tuple((SAFETY * largest).tolist())


def _slope_between(field: Float32[np.ndarray, "x y z"], grid: Grid) -> float:
    """The largest |p| / d of points that stay on the wrong side, whichever eighth of the grid's points it is that they are predicted from."""
    largest = 0.0
    for start in np.ndindex(2, 2, 2):
        values = field[tuple(slice(first, None) for first in start)]
        predicted = predicted_between(values[EVERY_SECOND], values.shape)
        is_wrong = _stays_wrong(predicted < 0, values < 0)
        largest = max(largest, float((np.abs(predicted[is_wrong]) / reach_between(grid, values.shape)[is_wrong]).max(initial=0.0)))
    return largest


def _stays_wrong(is_thought_inside: Bool[np.ndarray, "x y z"], is_inside: Bool[np.ndarray, "x y z"]) -> Bool[np.ndarray, "x y z"]:
    """Points thought to be on the wrong side after the search has asked at the ends of all cut edges, those that this shows to be cut included."""
    is_thought_inside = is_thought_inside.copy()
    while True:
        is_wrong = is_thought_inside != is_inside
        is_turned = is_wrong & ends_of_cut_edges(is_thought_inside)
        if not is_turned.any():
            return is_wrong
        is_thought_inside ^= is_turned


def cut_cells(is_inside: Bool[np.ndarray, "x y z"]) -> Bool[np.ndarray, "x y z"]:
    """Whether the cell whose lower corner each point is has corners on both sides; false for the last points, which have no cell."""
    some, every = is_inside, is_inside
    for axis in range(3):
        pairs = [tuple(slice(k, k - 1 or None) if a == axis else slice(None) for a in range(3)) for k in (0, 1)]
        some, every = some[pairs[0]] | some[pairs[1]], every[pairs[0]] & every[pairs[1]]
    return np.pad(some & ~every, (0, 1))
