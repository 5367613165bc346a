"""Surfaces from signed distances on a grid (paper section 4, Shape Reconstructions)."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64, Int64
from torch import Tensor

from sdfnet.errors import ConfigurationError, ReconstructionError
from sdfnet.evaluation.marching import marching_cubes
from sdfnet.geometry.surface import Surface

# A value closer to zero than this part of the spacing is moved that far away, keeping its side: a triangle corner then
# never falls on a grid point, where up to eight corners would meet in triangles without area. 0.2 um on the bunny's grid.
LEVEL_MARGIN = 1e-4


@dataclass(frozen=True, eq=False)
class Grid:
    """Points of a regular grid that fills a box, its corners included."""

    lower: Float64[np.ndarray, "3"]  # m
    upper: Float64[np.ndarray, "3"]  # m
    resolution: int = 100  # points along each axis

    def __post_init__(self) -> None:
        if self.resolution < 2:
            raise ConfigurationError(f"a grid needs a resolution of at least 2 points along each axis, found {self.resolution}")
        if not (np.isfinite(self.lower).all() and np.isfinite(self.upper).all() and (self.lower < self.upper).all()):
            raise ConfigurationError(f"a grid's upper corner must lie above its lower one on every axis, found {self.lower} and {self.upper} m")

    @property
    def shape(self) -> tuple[int, int, int]:
        """Points along x, y, z."""
        return (self.resolution,) * 3

    @property
    def spacing(self) -> Float64[np.ndarray, "3"]:
        """Distance between neighbouring points along x, y, z, m."""
        return (self.upper - self.lower) / (self.resolution - 1)

    @cached_property
    def axes(self) -> tuple[Float64[np.ndarray, " points"], ...]:
        """Coordinates along x, y, z, m."""
        return tuple(np.linspace(low, high, self.resolution) for low, high in zip(self.lower, self.upper, strict=True))

    def points(self) -> Float32[Tensor, "points 3"]:
        """All grid points, m, z running fastest: a flat array of values reshapes to (x, y, z)."""
        axes = [torch.from_numpy(axis.astype(np.float32)) for axis in self.axes]
        return torch.stack(torch.meshgrid(*axes, indexing="ij"), dim=-1).reshape(-1, 3)

    def points_at(self, indices: Int64[np.ndarray, " points"]) -> Float32[Tensor, "points 3"]:
        """The grid points of these flat indices, m, the same bits as in `points`."""
        places = np.unravel_index(indices, self.shape)
        return torch.from_numpy(np.stack([axis.astype(np.float32)[place] for axis, place in zip(self.axes, places, strict=True)], axis=1))


def surface_from_values(values: Float32[Tensor, "x y z"], grid: Grid, start: tuple[int, int, int] | None = None) -> Surface:
    """The surface where the signed distance is zero, by marching cubes, normals towards positive values.

    Only the block of cells about the negative values is marched, which changes no triangle. The triangles depend on the
    side of every value, and on the values at the ends of edges along which the side changes. With a `start`, the values
    are those of a block of the grid whose first point is there, and which has no negative value on a face of its own
    (`SparseValues`). Raises ReconstructionError when a value is not finite, when there is no zero crossing, and when the
    surface leaves through faces of the box.
    """
    if start is None and tuple(values.shape) != grid.shape:
        raise ReconstructionError(f"values must have the grid's shape {grid.shape}, found {tuple(values.shape)}")
    field = values.detach().cpu().numpy()
    is_inside = field < 0
    _require_surface(field, is_inside)
    first, last = extent(is_inside)
    occupied = tuple(slice(low - 1, high + 2) for low, high in zip(first, last, strict=True))
    margin = np.float32(LEVEL_MARGIN * grid.spacing.min())
    block = field[occupied].copy()
    flat = block.reshape(-1)
    at_level = np.flatnonzero(np.abs(flat) < margin)
    flat[at_level] = np.where(flat[at_level] < 0, -margin, margin)
    corners, triangles = marching_cubes(block)
    place = first - 1 if start is None else first - 1 + start
    return Surface(grid.lower + (corners + place) * grid.spacing, triangles)


def values_of_frames(
    field: Callable[[Float32[Tensor, "points 3"]], Float32[Tensor, "frames points"]], grid: Grid, rows: int = 16_384
) -> Float32[Tensor, "frames x y z"]:
    """Values (m) of `field` on the whole grid for several frames at once, about `rows` values a call.

    All frames are asked at the same points, so `field` can compute once what does not depend on the frame, such as an
    encoding. A 64-64 decoder with 64 frequencies took 0.15 us a value on one core at 16 or 101 frames; more rows than
    the cache holds made it three times slower, and one frame at a time pays the encoding for each. The result takes
    4 bytes x frames x resolution^3.
    """
    points = grid.points()
    with torch.inference_mode():
        frames = len(field(points[:1]))
        values = torch.empty(frames, len(points))
        step = max(1, rows // frames)
        for start in range(0, len(points), step):
            values[:, start : start + step] = field(points[start : start + step])
    return values.reshape(frames, *grid.shape)


def extent(is_inside: Bool[np.ndarray, "x y z"]) -> tuple[Int64[np.ndarray, "3"], Int64[np.ndarray, "3"]]:
    """First and last place along each axis that holds what is inside. There must be any."""
    below = np.logical_or.reduce(is_inside, axis=0)  # for both other axes: a fifth of the time of going through everything for each
    filled = [np.flatnonzero(places) for places in (is_inside.any(axis=(1, 2)), below.any(axis=1), below.any(axis=0))]
    return np.array([places[0] for places in filled]), np.array([places[-1] for places in filled])


def _require_surface(field: np.ndarray, is_inside: np.ndarray) -> None:
    lowest, highest = float(field.min()), float(field.max())
    if not (np.isfinite(lowest) and np.isfinite(highest)):
        bad = int((~np.isfinite(field)).sum())
        raise ReconstructionError(f"every value must be finite, found {bad} of {field.size} that are not; the network or its input has diverged")
    if lowest >= 0 or highest < 0:
        raise ReconstructionError(
            f"a surface needs values on both sides of zero, found {lowest:.3g} to {highest:.3g} m; train longer, or check that distance is negative inside"
        )
    sides = [(axis, side, index) for axis in range(3) for side, index in (("lower", 0), ("upper", -1))]
    inside = {f"the {side} {'xyz'[axis]} face": int(is_inside.take(index, axis=axis).sum()) for axis, side, index in sides}
    cut = ", ".join(f"{count} on {face}" for face, count in inside.items() if count)
    if cut:
        raise ReconstructionError(
            f"the surface must close inside the grid, found points inside it on the box: {cut}; enlarge the box if the solid leaves it, else train longer"
        )
