"""Signed distance to a deforming surface. The sign convention of the whole project is set here: negative inside.

The bounding volume hierarchy is built once and refitted to each frame. The sign comes from angle-weighted pseudo-normals
(Baerentzen and Aanaes 2005), which are exact for a closed surface that does not cross itself.
"""

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
import warp as wp
from jaxtyping import Float32, Float64, Int32, Int64, Num
from torch import Tensor

from sdfnet.checked import taken
from sdfnet.errors import GeometryError
from sdfnet.geometry.distance_kernel import query_kernel
from sdfnet.geometry.surface import Surface
from sdfnet.geometry.warp_start import start_warp

# A closest point nearer than this to an edge or corner, in barycentric coordinates, takes the normal of that edge or
# corner: ten times the float32 error of the coordinates on triangles of 1 % of the solid's size.
FEATURE_TOLERANCE = 1e-5
# Rounding margins on an upper bound of the search distance, so that float32 can never exclude the true closest point:
# a part of the bound, and a part of the solid's diagonal (eight float32 steps there) for points that are almost on the surface.
BOUND_MARGIN = 1.0 + 1e-5
DIAGONAL_MARGIN = 1e-6

Positions = Num[Tensor, "points 3"] | Num[np.ndarray, "points 3"] | Sequence[Sequence[float]]  # m


@dataclass(frozen=True, eq=False)
class Closest:
    """The nearest triangle of each point: unsigned distance (m), unit face normal, face index."""

    distance: Float32[Tensor, " points"]
    normals: Float32[Tensor, "points 3"]
    face: Int32[Tensor, " points"]


class SurfaceDistance:
    """Distance to one surface whose vertices move and whose faces stay.

    Not for a surface that crosses itself: the distance stays right, the sign inside the overlap does not.
    Raises GeometryError when the surface is not closed, for then inside has no meaning, and when a vertex is not finite;
    with `is_closed` false an open surface is taken too and only `closest` means something.
    """

    def __init__(self, surface: Surface, device: str = "cpu", is_closed: bool = True) -> None:
        _require_finite(surface.vertices)
        self._device = device
        self._faces = surface.faces
        self._rounding = DIAGONAL_MARGIN * surface.diagonal
        own_face = np.repeat(np.arange(len(surface.faces))[:, None], 3, axis=1)
        self._neighbours = _faces_across_edges(surface.faces) if is_closed else own_face
        # Centred coordinates keep float32 at its best.
        self._centre = (surface.vertices.min(axis=0) + surface.vertices.max(axis=0)) / 2
        start_warp()
        self._mesh = wp.Mesh(
            points=wp.array((surface.vertices - self._centre).astype(np.float32), dtype=wp.vec3, device=device),
            indices=wp.array(surface.faces.astype(np.int32).ravel(), dtype=wp.int32, device=device),
            bvh_constructor="sah" if device == "cpu" else "lbvh",  # the surface area heuristic is 1.3 times as fast on the CPU
        )
        self._normals: list[wp.array] = []
        self._set_normals(surface.vertices)

    def deform(self, vertices: Positions) -> None:
        """Move the surface to new vertex positions (m); the hierarchy is refitted, not rebuilt. Raises GeometryError when one is not finite."""
        moved: np.ndarray = taken("vertices", vertices, Float64[np.ndarray, "vertices 3"])
        if len(moved) != self._mesh.points.size:
            raise GeometryError(
                f"a surface that deforms keeps its {self._mesh.points.size} vertices, found {len(moved)}; "
                "give those of Trajectory.surface(frame).vertices, and for another surface make another SurfaceDistance"
            )
        _require_finite(moved)
        self._mesh.points.assign((moved - self._centre).astype(np.float32))
        self._mesh.refit()
        self._set_normals(moved)

    def signed_distance(self, points: Positions, upper_bound: Float32[Tensor, " points"] | None = None) -> Float32[Tensor, " points"]:
        """Distance (m) of each point to the surface, negative inside.

        `upper_bound` (m) is a distance that is known not to be exceeded, such as the last frame's plus the largest
        movement; it only makes the search faster. Points in Morton order (`morton_order`) are 1.4 times as fast.
        """
        points = _as_points(points)
        bounds = torch.full((len(points),), torch.inf) if upper_bound is None else upper_bound * BOUND_MARGIN + self._rounding
        distances, faces = self._query(points, bounds)
        missed = int((faces < 0).sum())
        if missed:
            raise GeometryError(f"{missed} of {len(points)} points found no surface within their bound; the points or the bound are not finite or too small")
        return distances

    def closest(self, points: Positions, within: float) -> Closest:
        """The nearest triangle within a radius (m); where there is none the face is -1 and the distance is `within`."""
        points = _as_points(points)
        distances, faces = self._query(points, torch.full((len(points),), within))
        normals = torch.from_numpy(self._face_normals.astype(np.float32))[faces.long().cpu()].to(points.device)
        return Closest(distances.abs(), normals, faces)

    def _query(self, points: Tensor, bounds: Tensor) -> tuple[Tensor, Tensor]:
        centre = torch.as_tensor(self._centre, dtype=torch.float64)
        local = (points.to(torch.float64) - centre.to(points.device)).float().contiguous().to(self._device)
        bounds = bounds.to(torch.float32).contiguous().to(self._device)
        distances, faces = torch.empty_like(bounds), torch.empty(len(bounds), dtype=torch.int32, device=self._device)
        # On the CPU Warp runs a launch on one thread and releases the interpreter lock.
        pieces = min(os.cpu_count() or 1, max(1, len(points) // 4096)) if self._device == "cpu" else 1
        slices = [slice(len(points) * k // pieces, len(points) * (k + 1) // pieces) for k in range(pieces)]

        def launch(part: slice) -> None:
            if part.stop > part.start:
                wp.launch(
                    query_kernel,
                    dim=part.stop - part.start,
                    inputs=[
                        self._mesh.id,
                        wp.from_torch(local[part], dtype=wp.vec3),
                        wp.from_torch(bounds[part]),
                        *self._normals,
                        FEATURE_TOLERANCE,
                        wp.from_torch(distances[part]),
                        wp.from_torch(faces[part]),
                    ],
                    device=self._device,
                )

        if pieces == 1:
            launch(slices[0])
        else:
            with ThreadPoolExecutor(pieces) as pool:
                list(pool.map(launch, slices))
        wp.synchronize_device(self._device)
        return distances.to(points.device), faces.to(points.device)

    def _set_normals(self, vertices: np.ndarray) -> None:
        corners = vertices[self._faces]
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), np.finfo(np.float64).tiny)
        toward = np.roll(corners, -1, axis=1) - corners
        toward /= np.maximum(np.linalg.norm(toward, axis=2, keepdims=True), np.finfo(np.float64).tiny)
        cosines = -np.einsum("fij,fij->fi", toward, np.roll(toward, 1, axis=1))
        angles = np.arccos(np.clip(cosines, -1.0, 1.0))
        vertex_normals = np.zeros_like(vertices)
        np.add.at(vertex_normals, self._faces, angles[:, :, None] * normals[:, None, :])
        edge_normals = normals[:, None, :] + normals[self._neighbours]
        self._face_normals = normals
        of_features = (normals, edge_normals, vertex_normals[self._faces])
        self._normals = [wp.array(values.astype(np.float32), dtype=wp.vec3, device=self._device) for values in of_features]


def signed_distance(points: Positions, surface: Surface) -> Float32[Tensor, " points"]:
    """Signed distance (m) of points to one closed surface, negative inside. For many frames keep a `SurfaceDistance`."""
    return SurfaceDistance(surface).signed_distance(points)


def morton_order(points: Float32[np.ndarray, "points 3"]) -> Int64[np.ndarray, " points"]:
    """The permutation that sorts points along a Morton (Z-order) curve of 2^10 cells a side, so that neighbours in memory are neighbours in space."""
    extent = np.maximum(np.ptp(points, axis=0), np.finfo(np.float32).tiny)
    cells = np.minimum((points - points.min(axis=0)) / extent * 1024, 1023).astype(np.uint32)
    for shift, mask in ((16, 0x030000FF), (8, 0x0300F00F), (4, 0x030C30C3), (2, 0x09249249)):
        cells = (cells | (cells << np.uint32(shift))) & np.uint32(mask)
    return np.argsort(cells[:, 0] << np.uint32(2) | cells[:, 1] << np.uint32(1) | cells[:, 2], kind="stable")


def _as_points(points: Any) -> Tensor:
    """Points as PyTorch has them; arrays and lists are taken too."""
    given = torch.as_tensor(points)
    if given.ndim != 2 or given.shape[1] != 3:
        raise GeometryError(f"points must have the shape (points, 3), found {tuple(given.shape)}; for a single point write [[x, y, z]]")
    return given


def _require_finite(vertices: np.ndarray) -> None:
    bad = np.flatnonzero(~np.isfinite(vertices).all(axis=1))
    if len(bad):  # a hierarchy of boxes that are not finite finds some faces and loses others
        raise GeometryError(f"surface vertices must be finite, found {len(bad)} that are not, the first at index {bad[0]}; find where the solid diverged")


def _faces_across_edges(faces: np.ndarray) -> np.ndarray:
    """For each face the face across its edges 01, 12 and 20, shape (faces, 3)."""
    edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    order = np.lexsort((edges[:, 1], edges[:, 0]))
    paired = edges[order]
    if len(paired) % 2 or (paired[0::2] != paired[1::2]).any() or (paired[1:-1:2] == paired[2::2]).all(axis=1).any():
        raise GeometryError("signed distance needs a closed surface, every edge shared by exactly two faces; repair the mesh first")
    across = np.empty(len(edges), dtype=np.int64)
    across[order[0::2]], across[order[1::2]] = order[1::2] // 3, order[0::2] // 3
    return across.reshape(-1, 3)
