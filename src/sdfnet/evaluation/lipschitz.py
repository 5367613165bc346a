"""How fast a field rises from its surface, measured: what a sparse reconstruction must know of a network."""

import numpy as np
from jaxtyping import Bool, Float32

from sdfnet.evaluation.reconstruct import Grid
from sdfnet.evaluation.sparse import EVERY_SECOND, STEPS, ends_of_cut_edges, predicted_between, reach_between

# Measured slopes are raised by this factor for what was not measured: the frames between.
SAFETY = 1.1
# Before that, no slope is less than this. Balls of 0.9 to 3 cells, alone and beside a large one, are then missed as rarely as with slopes
# of one: those of less than a cell that hold a single grid point. Between the last points more is not needed where the search follows the surface.
LEAST = (0.8, 0.8, 0.25)


def measured_slopes(values: Float32[np.ndarray, "frames x y z"], grid: Grid) -> tuple[float, ...]:
    """For each of STEPS the L to search other frames of the same field with: SAFETY times the largest that is found.

    That is |p| / d of a point that is predicted on the wrong side and that following the surface from the other points
    does not reach, wherever on the grid the coarser points lie. It is not the largest gradient: far from its surface a
    network may be as steep as it likes. The guarantee is that of the measurement: a frame with a piece of surface apart
    from the rest, at which the field rises faster than at any that was measured, and by more than SAFETY, can lose it.
    """
    largest = np.array(LEAST)
    for field in values:
        largest = np.maximum(largest, [_slope_between(field, grid, step) for step in STEPS])
    return tuple((SAFETY * largest).tolist())


def _slope_between(field: Float32[np.ndarray, "x y z"], grid: Grid, step: int) -> float:
    """The largest |p| / d of points that stay on the wrong side, from eight places of the coarser points."""
    largest = 0.0
    for start in np.ndindex(2, 2, 2):
        values = field[tuple(slice(step * first, None, step) for first in start)]
        if not values.size:  # fewer points on the whole grid than to the second of a level
            continue
        predicted = predicted_between(values[EVERY_SECOND], values.shape)
        is_wrong = _stays_wrong(predicted < 0, values < 0)
        reach = step * reach_between(grid, values.shape)
        largest = max(largest, float((np.abs(predicted[is_wrong]) / reach[is_wrong]).max(initial=0.0)))
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
