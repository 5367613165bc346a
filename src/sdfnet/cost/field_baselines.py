"""Deforming shapes kept as distance fields: a network, stored distances on a grid, and KNN-1; their surfaces come from marching cubes.

`bytes` is all that must be kept to answer for every frame, the box apart. Distances are in metres, negative inside.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
import torch
from jaxtyping import Float32, Float64
from scipy.spatial import cKDTree
from torch import Tensor
from torch.nn.functional import grid_sample

from sdfnet.cost.shape_baselines import DeformedMesh
from sdfnet.data.store import DistanceSamples
from sdfnet.errors import ConfigurationError
from sdfnet.evaluation.baselines import nearest_sample_bytes
from sdfnet.evaluation.lipschitz import frames_to_measure, measured_slopes
from sdfnet.evaluation.reconstruct import Grid, surface_from_values
from sdfnet.evaluation.sparse import sparse_values
from sdfnet.evaluation.sparse_network import SparseReconstruction
from sdfnet.geometry.distance import SurfaceDistance
from sdfnet.geometry.surface import Surface
from sdfnet.models.networks import Networks
from sdfnet.physics.trajectory import Trajectory


class NetworkField:
    """Networks with the latent of every frame."""

    def __init__(self, networks: Networks, vertices: Float64[np.ndarray, "frames vertices 3"]) -> None:
        """Raises ConfigurationError when the networks were trained on another mesh."""
        mean_shape = getattr(networks.encoder, "mean_shape", None)  # learned latents have none and refuse other shapes themselves
        if mean_shape is not None and mean_shape.shape[-2:] != vertices.shape[-2:]:
            raise ConfigurationError(f"networks of {mean_shape.shape[-2]} vertices need a mesh of as many, found {vertices.shape[1]}; give the data they had")
        self.decoder = networks.eval().cpu().decoder
        self.latents = networks.latents(torch.from_numpy(vertices.astype(np.float32)))
        self.bytes = networks.sizes(len(vertices))["query_bytes"]

    def distances(self, frame: int, points: Float32[Tensor, "points 3"]) -> Float32[Tensor, " points"]:
        """The decoder's distances (m), in float32 and without gradients."""
        return self.decoder.distances(self.latents[frame], points)


@dataclass(frozen=True, eq=False)
class GridField:
    """Stored distances on a regular grid over a box, one grid a frame, between them trilinear; outside the box the value at its face.

    Not where the grid is coarser than the solid is thick: a part without a grid point inside has no surface.
    """

    values: Float32[np.ndarray, "frames x y z"]  # m
    lower: Float64[np.ndarray, "3"]  # m, as is `upper`
    upper: Float64[np.ndarray, "3"]

    @classmethod
    def of(cls, trajectory: Trajectory, grid: Grid) -> "GridField":
        """Exact distances of every frame at the grid's points."""
        distance, points = SurfaceDistance(trajectory.surface(0)), grid.points()
        values = np.empty((len(trajectory.times), *grid.shape), dtype=np.float32)
        for frame, vertices in enumerate(trajectory.surface_vertices):
            distance.deform(vertices)
            values[frame] = distance.signed_distance(points).reshape(grid.shape)
        return cls(values, grid.lower, grid.upper)

    @property
    def bytes(self) -> int:
        """The values of all frames."""
        return self.values.nbytes

    def distances(self, frame: int, points: Float32[Tensor, "points 3"]) -> Float32[Tensor, " points"]:
        """Trilinear interpolation between the eight grid points about each point, m."""
        lower, upper = (torch.from_numpy(corner).float() for corner in (self.lower, self.upper))
        places = (2 * (points - lower) / (upper - lower) - 1).flip(-1)  # -1 to 1 in the box, the axis that runs fastest first
        values = torch.from_numpy(self.values[frame])[None, None]
        return grid_sample(values, places[None, None, None], align_corners=True, padding_mode="border")[0, 0, 0, 0]


class NearestSampleField:
    """KNN-1 with `count` of the samples that the paper's filter keeps in each frame; the search tree is built when the frame changes.

    Positions and distances are looked up in the samples that all frames share. Many queries at the same points: `NearestSample`.
    """

    def __init__(self, samples: DistanceSamples, count: int | None = None) -> None:
        """All samples for a count of None. Raises ConfigurationError for more than a frame keeps."""
        kept = samples.kept.shape[1]
        count = kept if count is None else count
        if not 1 <= count <= kept:
            raise ConfigurationError(f"KNN-1 needs between 1 and the {kept} samples that a frame keeps, found {count}")
        chosen = np.sort(np.random.default_rng(0).permutation(kept)[:count])
        self._samples, self._kept = samples, samples.kept[:, chosen]
        self._frame: int | None = None

    @property
    def bytes(self) -> int:
        """Of the samples of all frames."""
        return nearest_sample_bytes(self._kept)

    def distances(self, frame: int, points: Float32[Tensor, "points 3"]) -> Float32[Tensor, " points"]:
        """The distance (m) of the frame's nearest sample."""
        selection = self._kept[frame]
        if frame != self._frame:
            self._tree, self._frame = cKDTree(self._samples.points[selection]), frame
        _, nearest = self._tree.query(points.numpy(), workers=-1)
        return torch.from_numpy(self._samples.distances[frame][selection[nearest]])


@dataclass(frozen=True, eq=False)
class MarchedField:
    """A distance field as a shape model: its surface is found by marching cubes."""

    field: NetworkField | GridField | NearestSampleField
    surface: Callable[[int], Surface]  # of a frame. Raises ReconstructionError where the field has no closed surface

    @property
    def bytes(self) -> int:
        """The field's."""
        return self.field.bytes

    def distances(self, frame: int, points: Float32[Tensor, "points 3"]) -> Float32[Tensor, " points"]:
        """The field's distances, m."""
        return self.field.distances(frame, points)


def on_whole_grid(field: NearestSampleField, grid: Grid) -> MarchedField:
    """The field asked at every point of the grid."""
    return MarchedField(field, lambda frame: surface_from_values(field.distances(frame, grid.points()).reshape(grid.shape), grid))


def network_where_it_may_be(field: NetworkField, grid: Grid) -> MarchedField:
    """Networks as evaluation marches them: the triangles of the whole grid, from the points where the surface may be.

    The first surface asks the networks at the whole grid in three frames, to know where the later ones need not be asked.
    """

    @cache
    def reconstruction() -> SparseReconstruction:
        return SparseReconstruction.measured(field.decoder, grid, field.latents)

    return MarchedField(field, lambda frame: reconstruction().surface(field.latents[frame]))


def distances_where_it_may_be(field: GridField, grid: Grid) -> MarchedField:
    """Stored distances marched as networks are, with slopes that are measured in the same three frames; KNN-1 jumps, and cannot be."""

    @cache
    def slopes() -> tuple[float, ...]:
        points = grid.points()
        few = [field.distances(frame, points).reshape(grid.shape).numpy() for frame in frames_to_measure(len(field.values))]
        return measured_slopes(np.stack(few), grid)

    def surface(frame: int) -> Surface:
        found = sparse_values(lambda indices: field.distances(frame, grid.points_at(indices)).numpy(), grid, slopes())
        return surface_from_values(torch.from_numpy(found.values), grid, found.start)

    return MarchedField(field, surface)


ShapeModel = DeformedMesh | MarchedField
