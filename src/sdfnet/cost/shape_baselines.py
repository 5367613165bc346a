"""Deforming shapes kept as meshes: proper orthogonal decomposition and kept frames, both asked by an exact query on the moved mesh.

`bytes` is all that must be kept to answer for every frame. Moving to another frame is part of the price of asking there.
"""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float32, Float64, Int64
from torch import Tensor

from sdfnet.errors import ConfigurationError
from sdfnet.geometry.distance import SurfaceDistance
from sdfnet.geometry.surface import Surface


@dataclass(frozen=True, eq=False)
class PodMotion:
    """x_i = mean + sum_k c_ik m_k, proper orthogonal decomposition: no other `count` modes leave a smaller squared error over the frames.

    Everything is kept in float32. Not for families that few modes do not span, such as solids that turn.
    """

    mean: Float32[np.ndarray, "vertices 3"]  # m
    modes: Float32[np.ndarray, "modes vertices 3"]  # without unit, orthonormal
    coefficients: Float32[np.ndarray, "frames modes"]  # m

    @classmethod
    def of(cls, vertices: Float64[np.ndarray, "frames vertices 3"], count: int) -> "PodMotion":
        """The first `count` modes of all frames. Raises ConfigurationError for more modes than there are frames."""
        if not 1 <= count <= len(vertices):
            raise ConfigurationError(f"the number of POD modes must lie between 1 and the {len(vertices)} frames, found {count}")
        mean = vertices.mean(axis=0)
        left, values, right = np.linalg.svd((vertices - mean).reshape(len(vertices), -1), full_matrices=False)
        modes = right[:count].reshape(-1, *mean.shape)
        return cls(mean.astype(np.float32), modes.astype(np.float32), (left * values)[:, :count].astype(np.float32))

    @property
    def bytes(self) -> int:
        """Mean shape, modes and coefficients."""
        return self.mean.nbytes + self.modes.nbytes + self.coefficients.nbytes

    def vertices(self, frame: int) -> Float64[np.ndarray, "vertices 3"]:
        """Vertices of a frame, m."""
        return (self.mean + np.tensordot(self.coefficients[frame], self.modes, axes=1)).astype(np.float64)


@dataclass(frozen=True, eq=False)
class KeptFrames:
    """Of each load case every `stride`-th frame and the last are kept in float32; between two of them each vertex goes straight.

    Frames are taken as equally far apart in time.
    """

    frames: Int64[np.ndarray, " kept"]
    positions: Float32[np.ndarray, "kept vertices 3"]  # m

    @classmethod
    def of(cls, vertices: Float64[np.ndarray, "frames vertices 3"], stride: int, cases: int = 1) -> "KeptFrames":
        """Keep frames 0, `stride`, 2 `stride` and so on of each of `cases` equally long cases. Raises ConfigurationError for a stride below 1."""
        if stride < 1:
            raise ConfigurationError(f"the stride of the kept frames must be at least 1, found {stride}")
        length = len(vertices) // cases
        kept = np.array([frame for frame in range(len(vertices)) if frame % length % stride == 0 or frame % length == length - 1])
        return cls(kept, vertices[kept].astype(np.float32))

    @property
    def bytes(self) -> int:
        """The kept positions; which frames they are follows from the stride."""
        return self.positions.nbytes

    def vertices(self, frame: int) -> Float64[np.ndarray, "vertices 3"]:
        """Vertices of a frame, m."""
        after = int(np.searchsorted(self.frames, frame))
        if self.frames[after] == frame:
            return self.positions[after].astype(np.float64)
        before = after - 1
        share = (frame - self.frames[before]) / (self.frames[after] - self.frames[before])
        return (1 - share) * self.positions[before].astype(np.float64) + share * self.positions[after]


Motion = PodMotion | KeptFrames


class DeformedMesh:
    """The exact distance to a mesh that a motion moves: vertices rebuilt, search tree refitted whenever the frame changes."""

    def __init__(self, motion: Motion, faces: Int64[np.ndarray, "faces 3"]) -> None:
        self._motion = motion
        self._faces = faces.astype(np.min_scalar_type(int(faces.max())))  # 2 bytes a corner up to 65,536 vertices
        self._frame = 0

    @property
    def bytes(self) -> int:
        """The motion and the faces."""
        return self._motion.bytes + self._faces.nbytes

    def distances(self, frame: int, points: Float32[Tensor, "points 3"]) -> Float32[Tensor, " points"]:
        """Signed distance (m) to the moved mesh, exact."""
        if frame != self._frame:
            self._distance.deform(self._motion.vertices(frame))
            self._frame = frame
        return self._distance.signed_distance(points)

    def surface(self, frame: int) -> Surface:
        """The moved mesh itself, of the true topology."""
        return Surface(self._motion.vertices(frame), self._faces.astype(np.int64))

    @cached_property
    def _distance(self) -> SurfaceDistance:
        return SurfaceDistance(self.surface(self._frame))
