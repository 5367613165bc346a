"""How fast a field rises from its surface, measured: what a sparse reconstruction must know of a network."""

import numpy as np
from jaxtyping import Float32

from sdfnet.evaluation.reconstruct import Grid
from sdfnet.evaluation.sparse import COARSEST, sparse_values

# No slopes are less than these. Of true distances they lose balls of a radius of 0.9 to 3 cells, alone and beside a large one, as rarely as slopes of
# one do at the coarser levels: those that hold a single grid point. Between the last points more is not needed where the search follows the surface.
LEAST = (0.8, 0.8, 0.25)
RAISE = 1.25  # what all slopes are multiplied with until the search loses nothing
SAFETY = 1.1  # and once more, for the frames between those that were measured


def frames_to_measure(count: int) -> list[int]:
    """Which of so many frames the slopes are measured in: the first, the middle and the last."""
    return sorted({0, count // 2, count - 1})


def measured_slopes(values: Float32[np.ndarray, "frames x y z"], grid: Grid) -> tuple[float, ...]:
    """For each of STEPS the L to search other frames of the same field with: enough to lose no point of these, and SAFETY times more.

    The search itself is the judge, in every frame and with its coarsest points at eight places. It is not asked for the
    largest gradient: far from its surface a network may be as steep as it likes, and what is joined to a piece that was
    found is followed. The guarantee is that of the measurement: a frame with a piece of surface apart from the rest, at
    which the field rises faster than in all that were measured, can lose it. Frames with values that are not finite say nothing.
    """
    slopes = np.array(LEAST)
    for field in values:
        if not np.isfinite(field).all():
            continue
        for first in range(min(COARSEST, grid.resolution - 1)):
            part = field[first:, first:, first:]
            while not _finds_every_side(part, grid, first, tuple(slopes.tolist())):
                slopes *= RAISE
    return tuple((SAFETY * slopes).tolist())


def _finds_every_side(part: Float32[np.ndarray, "x y z"], grid: Grid, first: int, slopes: tuple[float, ...]) -> bool:
    values, own = part.reshape(-1), Grid(grid.lower + first * grid.spacing, grid.upper, len(part))
    found = sparse_values(lambda indices: values[indices], own, slopes)
    block = tuple(slice(low, low + count) for low, count in zip(found.start, found.values.shape, strict=True))
    is_inside = part < 0
    return bool(np.array_equal(found.values < 0, is_inside[block]) and is_inside.sum() == is_inside[block].sum())
