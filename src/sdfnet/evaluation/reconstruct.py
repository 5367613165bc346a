"""Surfaces from signed distances on a grid (paper section 4, Shape Reconstructions)."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float32, Float64
from skimage.measure import marching_cubes
from torch import Tensor

from sdfnet.errors import ConfigurationError, ReconstructionError
from sdfnet.geometry.distance import SurfaceDistance
from sdfnet.geometry.surface import Surface

# A value closer to zero than this part of the spacing is moved that far away, keeping its side: a triangle corner then
# never falls on a grid point, where up to eight corners would meet in triangles without area. 0.2 um on the bunny's grid.
LEVEL_MARGIN = 1e-4
# Block sizes, in grid points, of the coarse-to-fine search for the surface. The last is the grid itself.
BLOCKS = (8, 4, 2, 1)


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


def surface_from_values(values: Float32[Tensor, "x y z"], grid: Grid) -> Surface:
    """The surface where the signed distance is zero, by marching cubes, normals towards positive values.

    Only the block of cells about the negative values is marched, which changes no triangle. Raises ReconstructionError
    when a value is not finite, when there is no zero crossing, and when the surface leaves through faces of the box.
    """
    if tuple(values.shape) != grid.shape:
        raise ReconstructionError(f"values must have the grid's shape {grid.shape}, found {tuple(values.shape)}")
    field = values.detach().cpu().numpy()
    _require_surface(field)
    filled = [np.flatnonzero((field < 0).any(axis=others)) for others in ((1, 2), (0, 2), (0, 1))]
    start = np.array([inside[0] - 1 for inside in filled])
    block = field[tuple(slice(inside[0] - 1, inside[-1] + 2) for inside in filled)]
    margin = np.float32(LEVEL_MARGIN * grid.spacing.min())
    clear_of_level = np.where(block < 0, np.minimum(block, -margin), np.maximum(block, margin))
    corners, triangles, _, _ = marching_cubes(clear_of_level, level=0.0, gradient_direction="descent")
    return Surface(grid.lower + (corners.astype(np.float64) + start) * grid.spacing, triangles.astype(np.int64))


def exact_values(distance: SurfaceDistance, grid: Grid) -> Float32[Tensor, "x y z"]:
    """Exact signed distance where marching cubes looks at it, and a value of the right sign everywhere else.

    Marching these values gives the floor: what the grid itself costs, with no network. Distance changes by at most one
    metre a metre, so a block of grid points whose centre is further from the surface than its half diagonal has one
    sign; blocks nearer than that and one cell more are split, down to single points. Same triangles as from asking at
    every point, for about a tenth of the queries. Not for measuring the field: far values are those of block centres.
    """
    resolution, half_cell = grid.resolution, np.linalg.norm(grid.spacing) / 2
    blocks_per_axis = -(-resolution // BLOCKS[0])
    values = torch.empty((blocks_per_axis * BLOCKS[0],) * 3)
    blocks = _corners(blocks_per_axis)
    for size in BLOCKS:
        first_point = np.stack([axis[index] for axis, index in zip(grid.axes, (blocks * size).T.numpy(), strict=True)], axis=1)
        centres = first_point + (size - 1) / 2 * grid.spacing
        block_values = distance.signed_distance(torch.from_numpy(centres.astype(np.float32)))
        by_block = values.unflatten(2, (-1, size)).unflatten(1, (-1, size)).unflatten(0, (-1, size)).permute(0, 2, 4, 1, 3, 5)
        by_block[tuple(blocks.T)] = block_values[:, None, None, None]
        if size > 1:
            near = blocks[block_values.abs() <= (size + 1 + LEVEL_MARGIN) * half_cell]
            halves = (2 * near[:, None] + _corners(2)).reshape(-1, 3)
            blocks = halves[(halves * (size // 2) < resolution).all(dim=1)]
    return values[:resolution, :resolution, :resolution].contiguous()


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


def _corners(count: int) -> Tensor:
    """All index triples below `count`, in grid order."""
    return torch.cartesian_prod(*[torch.arange(count)] * 3)


def _require_surface(field: np.ndarray) -> None:
    bad = int((~np.isfinite(field)).sum())
    if bad:
        raise ReconstructionError(f"every value must be finite, found {bad} of {field.size} that are not; the network or its input has diverged")
    lowest, highest = float(field.min()), float(field.max())
    if lowest >= 0 or highest < 0:
        raise ReconstructionError(
            f"a surface needs values on both sides of zero, found {lowest:.3g} to {highest:.3g} m; train longer, or check that distance is negative inside"
        )
    sides = [(axis, side, index) for axis in range(3) for side, index in (("lower", 0), ("upper", -1))]
    inside = {f"the {side} {'xyz'[axis]} face": int((field.take(index, axis=axis) < 0).sum()) for axis, side, index in sides}
    cut = ", ".join(f"{count} on {face}" for face, count in inside.items() if count)
    if cut:
        raise ReconstructionError(f"the surface must close inside the grid, found points inside it on the box: {cut}; enlarge the box")
