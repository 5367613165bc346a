"""The force of a moving rigid sphere on a surface, by pressure at points on the faces near it."""

import logging
from dataclasses import dataclass
from typing import final

import numpy as np
import torch
from jaxtyping import Float64, Int64
from torch import Tensor

from sdfnet.physics.effects.contact import LARGEST_PENETRATION, Penalty
from sdfnet.physics.effects.roles import ForceLaw, Report
from sdfnet.physics.elements import FiniteElements
from sdfnet.physics.loads import face_shape_functions

logger = logging.getLogger(__name__)

MARGIN = 0.5  # of the radius: how much farther than the sphere the faces near it are looked for, so that they are not looked for at every step


@dataclass(frozen=True, eq=False)
class FacePoints:
    """Equally weighted points on all boundary faces: the middles of the parts that each face is cut into."""

    faces: Int64[np.ndarray, "faces corners"]  # nodes: 3 of a face, or 6
    shape: Float64[np.ndarray, "corners points"]  # shape functions at the points, the same on every face

    def positions(self, nodes: Float64[np.ndarray, "nodes 3"]) -> Float64[np.ndarray, "faces points 3"]:
        """Where the points are, m."""
        result: np.ndarray = np.einsum("kq,fkd->fqd", self.shape, nodes[self.faces])
        return result


def face_points(elements: FiniteElements, parts: int) -> FacePoints:
    """parts^2 points on every face: its edges are cut into so many parts, and the face into as many equal triangles as that squared."""
    upright = [(i + 1 / 3, j + 1 / 3) for i in range(parts) for j in range(parts - i)]
    turned = [(i + 2 / 3, j + 2 / 3) for i in range(parts) for j in range(parts - i - 1)]
    return FacePoints(elements.boundary_faces, face_shape_functions(elements, np.array(upright + turned).T / parts))


@dataclass(frozen=True, eq=False)
class Touched:
    """The points within the sphere, in a fixed order."""

    faces: Int64[Tensor, " touched"]
    points: Int64[Tensor, " touched"]  # on the face
    offsets: Float64[Tensor, "3 touched"]  # from the centre, m
    distances: Float64[Tensor, " touched"]  # from the centre, m


@final
class SphereContact(ForceLaw):
    """f_a = sum over points of k depth N_a n w, with n away from the centre, depth = radius - |x - c| > 0 and w an equal part of the face's area at rest.

    It is minus the gradient of the sum of 1/2 k depth^2 w. The sphere moves with `velocity` until it has gone `travel`.
    Which points are touched is decided by the state alone: faces are looked for anew as soon as anything has moved
    by the margin, so none is missed, and those beyond the sphere add nothing.
    """

    is_driven = True

    def __init__(
        self,
        elements: FiniteElements,
        points: FacePoints,
        pushes: Penalty,
        center: Float64[np.ndarray, "3"],
        radius: float,
        velocity: Float64[np.ndarray, "3"],
        travel: float,
    ) -> None:
        self._points, self._pushes, self._radius, self._n_nodes = points, pushes, radius, len(elements.nodes)
        self._start, self._velocity = center, velocity
        speed = float(np.linalg.norm(velocity))
        self._end = travel / speed if speed > 0 else 0.0  # s
        self._surface = torch.from_numpy(np.unique(points.faces))
        self._faces = torch.from_numpy(np.searchsorted(self._surface.numpy(), points.faces))  # numbered in surface nodes
        self._rest = torch.from_numpy(elements.nodes[self._surface.numpy()])
        self._shape, self._weights = torch.from_numpy(points.shape), torch.from_numpy(pushes.areas / points.shape.shape[1])
        self._stiffness = torch.from_numpy(pushes.stiffness) * self._weights  # N/m of a point
        self._reach = float(np.abs(points.shape).sum(axis=0).max())  # how far a point can be from the middle of its nodes' box: 1 box for a flat face
        self._seen: tuple[Tensor, Tensor, Tensor] | None = None  # positions, centre and near faces when these were last looked for
        self._force = torch.zeros(self._n_nodes, 3, dtype=torch.float64)

    def force(self, displacement: Float64[Tensor, "nodes 3"], time: float) -> Float64[Tensor, "nodes 3"]:
        """The nodal force, N."""
        self._force.zero_()
        touched = self._touched(displacement, time)
        if len(touched.faces):
            strength = self._stiffness[touched.faces] * (self._radius - touched.distances) / touched.distances
            pushes = (touched.offsets * strength).T
            nodes = self._surface[self._faces[touched.faces]]
            for corner, shape in enumerate(self._shape):
                self._force.index_add_(0, nodes[:, corner], shape[touched.points][:, None] * pushes)
        return self._force

    def stored_energy(self, displacement: Float64[Tensor, "nodes 3"], time: float) -> float:
        """Sum of 1/2 k depth^2 w, J."""
        touched = self._touched(displacement, time)
        return float(0.5 * (self._stiffness[touched.faces] * (self._radius - touched.distances) ** 2).sum())

    def drive_work(self, force: Float64[Tensor, "nodes 3"], start: float, end: float) -> float:
        """Of the hand that moves the sphere: force times way, J."""
        way = self._velocity * (min(end, self._end) - min(start, self._end))
        return float(force.sum(dim=0) @ torch.from_numpy(way)) if way.any() else 0.0

    def added_stiffness(self) -> Float64[np.ndarray, " nodes"]:
        """The contact's tangent is at most sum of k w N_a N_b; its row sums, with the whole surface touched, N/m."""
        magnitudes = np.abs(self._points.shape)
        of_corner = magnitudes @ magnitudes.sum(axis=0) / magnitudes.shape[1]  # the mean over the points of |N_a| sum of |N_b|
        per_face = (self._pushes.stiffness * self._pushes.areas)[:, None] * of_corner
        return np.bincount(self._points.faces.ravel(), per_face.ravel(), minlength=self._n_nodes)

    def report(self, displacement: Float64[np.ndarray, "frames nodes 3"], times: Float64[np.ndarray, " frames"]) -> Report:
        """Force, indentation and contact area over the recorded frames; warns when the sphere itself gives way far."""
        force, area, indentation, penetration, share, frames = 0.0, 0.0, 0.0, 0.0, 0.0, 0
        edges = torch.from_numpy(self._pushes.edges)
        way = self._velocity / np.linalg.norm(self._velocity) if self._velocity.any() else np.zeros(3)
        for frame, time in zip(displacement, times, strict=True):
            nodal = torch.from_numpy(frame)
            touched = self._touched(nodal, float(time))
            if len(touched.faces) == 0:
                continue
            frames += 1
            depths = self._radius - touched.distances
            pushed = (nodal[self._surface] @ torch.from_numpy(way))[self._faces[touched.faces]]
            force = max(force, float(self.force(nodal, float(time)).sum(dim=0).norm()))
            area = max(area, float(self._weights[touched.faces].sum()))
            indentation = max(indentation, float((pushed * self._shape[:, touched.points].T).sum(dim=1).max()))
            penetration, share = max(penetration, float(depths.max())), max(share, float((depths / edges[touched.faces]).max()))
        if share > LARGEST_PENETRATION:
            logger.warning("the surface sinks into the finger by %.2g of an edge; raise finger.stiffness_factor or refine the mesh", share)
        return {
            "frames_in_contact": frames,
            "largest_force_N": force,
            "largest_contact_area_m2": area,
            "largest_indentation_m": indentation,
            "largest_penetration_m": penetration,
            "largest_penetration_per_edge": share,
        }

    def _touched(self, displacement: Float64[Tensor, "nodes 3"], time: float) -> Touched:
        center = torch.from_numpy(self._start + self._velocity * min(time, self._end))
        positions = self._rest + displacement.index_select(0, self._surface)
        near = self._near(positions, center)
        if len(near) == 0:
            return Touched(near, near, torch.zeros(3, 0, dtype=torch.float64), torch.zeros(0, dtype=torch.float64))
        corners = positions[self._faces[near]].permute(1, 2, 0)[..., None]  # (corners, 3, faces, 1)
        # Sum by sum, not by matrix products: their rounding would depend on which faces beyond the sphere are near.
        places = corners[0] * self._shape[0]
        for corner, shape in zip(corners[1:], self._shape[1:], strict=True):
            places += corner * shape
        offsets = places - center[:, None, None]
        squares = offsets[0] * offsets[0] + offsets[1] * offsets[1] + offsets[2] * offsets[2]
        faces, points = torch.nonzero(squares < self._radius**2, as_tuple=True)
        return Touched(near[faces], points, offsets[:, faces, points], squares[faces, points].sqrt())

    def _near(self, positions: Float64[Tensor, "surface 3"], center: Float64[Tensor, "3"]) -> Int64[Tensor, " near"]:
        """Faces whose box may meet the sphere, ascending."""
        margin = MARGIN * self._radius
        if self._seen is not None:
            moved = float((positions - self._seen[0]).abs().max()) * self._reach + float((center - self._seen[1]).abs().max())
            if moved <= margin:
                return self._seen[2]
        lower, upper = torch.aminmax(positions[self._faces], dim=1)
        gaps = ((lower + upper) / 2 - center).abs() - self._reach * (upper - lower) / 2
        near = (gaps <= self._radius + margin).all(dim=1).nonzero()[:, 0]
        self._seen = (positions, center, near)
        return near
