"""A rigid ball on a straight way: the paper's finger (Figure 2) as a contact instead of a pressure."""

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import trimesh
from jaxtyping import Bool, Float64

from sdfnet.errors import ConfigurationError, PhysicsError
from sdfnet.physics.effects.contact import check_factor, penalty, unit
from sdfnet.physics.effects.roles import FollowsState, ForceLaw
from sdfnet.physics.effects.sphere_contact import SphereContact, face_points
from sdfnet.physics.elasticity import ElasticModel, shape_gradients

logger = logging.getLogger(__name__)

POINTS_PER_RADIUS = 4  # along a face's edge: a contact half the radius wide then has some fifty points
MOST_PARTS = 32  # of an edge, 1024 points on a face
ROUNDING = 1e-9  # of a shape function: a point on the face between two tets is in one of them


@dataclass(frozen=True)
class RigidFinger(FollowsState):
    """Pressure k depth(x) in Pa where the surface is within the ball, along the line from its centre; depth = radius - |x - c(t)| in m.

    c(t) = center + direction * min(speed t, travel) in m: it starts at once with its full speed, goes `travel` far and
    stands. k = stiffness_factor (lambda + 2 mu) / edge in Pa/m, a penalty: the ball's surface gives way a little, in
    proportion to 1/stiffness_factor, and the report says how far. The pressure is integrated over the area at rest, at
    points on the faces, so the force has the exact potential 1/2 k depth^2 dA. No friction, no adhesion.

    For a poke whose depth is known and not its pressure, and for an obstacle to fall on (travel 0). Not for a ball
    smaller than an eighth of the faces' edges, nor for one that is fast against the waves in the solid.
    """

    center: tuple[float, float, float]  # m, at time 0, outside the solid
    radius: float = 0.003  # m
    direction: tuple[float, float, float] = (0.0, 0.0, -1.0)  # of the way; its length does not matter
    speed: float = 1.0  # m/s
    travel: float = 0.01  # m, how far it goes before it stands
    stiffness_factor: float = 10.0  # 1: the ball gives way like a layer of the solid's own tets; more gives way less and may need smaller steps

    def __post_init__(self) -> None:
        super().__post_init__()
        if not np.isfinite(self.center).all():
            raise ConfigurationError(f"finger.center must be finite, found {tuple(self.center)} m")
        if not (math.isfinite(self.radius) and self.radius > 0):
            raise ConfigurationError(f"finger.radius must be positive and finite, found {self.radius} m")
        for name, unit_name in (("speed", "m/s"), ("travel", "m")):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) >= 0):
                raise ConfigurationError(f"finger.{name} must be finite and not negative, found {getattr(self, name)} {unit_name}; turn finger.direction round")
        unit("finger.direction", self.direction)
        check_factor("finger", self.stiffness_factor)

    def force_law(self, model: ElasticModel, fixed: Bool[np.ndarray, "nodes 3"]) -> ForceLaw | None:
        """The ball's force on the surface.

        Raises PhysicsError when the ball touches the solid at rest and when it is too small for the faces. Warns when
        its way passes by the solid at rest.
        """
        if self.stiffness_factor == 0:
            return None
        center, direction = np.asarray(self.center, dtype=np.float64), unit("finger.direction", self.direction)
        self._check_start(model, center)
        pushes = penalty(model, self.stiffness_factor)
        points = face_points(model.elements, self._parts(float(pushes.edges.max())))
        distance = self._nearest_to_way(points.positions(model.elements.nodes).reshape(-1, 3), center, direction)
        if self.travel > 0 and self.speed > 0 and distance > self.radius:
            logger.warning(
                "the finger's way passes the solid at rest by %.3g m: it touches only what moves into it; turn finger.direction or raise finger.travel",
                distance - self.radius,
            )
        return SphereContact(model.elements, points, pushes, center, self.radius, self.speed * direction, self.travel)

    def _parts(self, edge: float) -> int:
        """Into how many parts an edge is cut for the points on a face."""
        parts = math.ceil(POINTS_PER_RADIUS * edge / self.radius)
        if parts > MOST_PARTS:
            raise PhysicsError(
                f"a finger's radius must be at least {POINTS_PER_RADIUS / MOST_PARTS:.3g} of the faces' edges, found {self.radius:.3g} m on edges up to "
                f"{edge:.3g} m; enlarge finger.radius or refine the mesh"
            )
        return parts

    def _check_start(self, model: ElasticModel, center: Float64[np.ndarray, "3"]) -> None:
        """The ball must be clear of the solid at rest."""
        mesh = model.mesh
        closest_point: Callable[..., np.ndarray] = trimesh.triangles.closest_point
        triangles = mesh.nodes[mesh.boundary_faces]
        distance = float(np.linalg.norm(closest_point(triangles, np.broadcast_to(center, (len(triangles), 3))) - center, axis=1).min())
        offsets = center - mesh.nodes[mesh.tets].mean(axis=1)
        shape = np.einsum("tia,ta->ti", shape_gradients(mesh), offsets) + 1 / 4
        is_inside = bool((shape >= -ROUNDING).all(axis=1).any())  # in some tet
        overlap = self.radius + (distance if is_inside else -distance)
        if overlap > 0:
            raise PhysicsError(
                f"a finger must start clear of the solid, found it {overlap:.4g} m deep in it at {tuple(self.center)} m; "
                "move finger.center back by that much or more, against finger.direction"
            )

    def _nearest_to_way(self, points: np.ndarray, center: np.ndarray, direction: np.ndarray) -> float:
        """The smallest distance of the points to the way of the centre, m."""
        travel = self.travel if self.speed > 0 else 0.0
        along = np.clip((points - center) @ direction, 0.0, travel)
        return float(np.linalg.norm(points - center - along[:, None] * direction, axis=1).min())
