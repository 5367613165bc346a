"""A finger's pressure on the part of the surface inside a sphere."""

import logging
import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import trimesh
from jaxtyping import Bool, Float64

from sdfnet.errors import ConfigurationError, PhysicsError
from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.effects.history import History
from sdfnet.physics.effects.roles import AddsLoad, Load
from sdfnet.physics.elasticity import ElasticModel
from sdfnet.physics.loads import traction_on_patch

logger = logging.getLogger(__name__)

AREA_TOLERANCE = 0.2  # relative; a flat patch is within 0.02 of pi R^2, more means an edge, a strong curvature or a mesh too coarse for it


@dataclass(frozen=True)
class PressurePoke(AddsLoad):
    """Pressure p in Pa on {x on the surface: |x - center| <= radius}: f = integral of -p n v dS in N (paper section 2, Gamma).

    For a touch whose force is known and whose shape does not matter, from time 0 on or as `history` says. The sphere
    also catches a second sheet of surface that it reaches, such as the back of a thin ear. Not for a finger that stops
    where it meets resistance, which is a rigid finger, and not for a patch that should follow the surface: it is that
    at rest.
    """

    center: tuple[float, float, float]  # m, on the surface
    radius: float = 0.003  # m
    pressure: float = 4000.0  # Pa; negative pulls, zero is the same as no poke
    direction: tuple[float, float, float] | None = None  # of the push; its length does not matter. None: against each face's outward normal
    history: History = field(default_factory=History)  # the factor on the pressure over time

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (math.isfinite(self.radius) and self.radius > 0):
            raise ConfigurationError(f"poke.radius must be positive and finite, found {self.radius} m")
        if not math.isfinite(self.pressure):
            raise ConfigurationError(f"poke.pressure must be finite, found {self.pressure} Pa")
        if self.direction is not None and not (np.isfinite(self.direction).all() and np.any(self.direction)):
            raise ConfigurationError(f"poke.direction must be finite and not zero, found {tuple(self.direction)}; null follows the surface's normal")

    def load(self, model: ElasticModel) -> Load:
        """The nodal force, with the loaded area and the resultant beside those of a flat disc, pi R^2 and p pi R^2.

        Raises PhysicsError when no quadrature point of the surface is inside the sphere.
        """
        mesh, center = model.mesh, np.asarray(self.center, dtype=np.float64)

        def inside(points: Float64[np.ndarray, "points 3"]) -> Bool[np.ndarray, " points"]:
            is_inside: np.ndarray = np.linalg.norm(points - center, axis=1) <= self.radius
            return is_inside

        corners = mesh.nodes[mesh.boundary_faces]
        middles = corners.mean(axis=1)
        reaches = np.linalg.norm(corners - middles[:, None], axis=2).max(axis=1)
        near = np.linalg.norm(middles - center, axis=1) <= self.radius + reaches
        direction = None if self.direction is None else np.asarray(self.direction, dtype=np.float64) / np.linalg.norm(self.direction)
        patch = traction_on_patch(model.elements, self.pressure, inside, direction, near)
        if patch.area == 0:
            raise PhysicsError(self._loads_nothing(mesh, center))
        disc = math.pi * self.radius**2
        resultant = float(np.linalg.norm(patch.resultant))
        message = "poke at %s m loads %.4g m^2 of pi R^2 = %.4g m^2; resultant %.4g N of p pi R^2 = %.4g N"
        level = logging.INFO if abs(patch.area / disc - 1) <= AREA_TOLERANCE else logging.WARNING
        logger.log(level, message, tuple(self.center), patch.area, disc, resultant, abs(self.pressure) * disc)
        report: dict[str, float | int | str] = {
            "loaded_area_m2": patch.area,
            "disc_area_m2": disc,
            "resultant_N": resultant,
            "disc_resultant_N": abs(self.pressure) * disc,
        }
        return Load(patch.nodal_force, abs(self.pressure), report, self.history)

    def _loads_nothing(self, mesh: TetMesh, center: Float64[np.ndarray, "3"]) -> str:
        triangles = mesh.nodes[mesh.boundary_faces]
        closest_point: Callable[..., np.ndarray] = trimesh.triangles.closest_point
        closest = closest_point(triangles, np.broadcast_to(center, (len(triangles), 3)))
        distances = np.linalg.norm(closest - center, axis=1)
        nearest = closest[distances.argmin()]
        found = f"a poke must load some of the surface, found nothing within {self.radius:.3g} m of {tuple(self.center)} m: the nearest surface"
        if distances.min() > self.radius:
            return f"{found} is {distances.min():.3g} m away at ({nearest[0]:.4g}, {nearest[1]:.4g}, {nearest[2]:.4g}) m; move poke.center there"
        return f"{found} is only {distances.min():.3g} m away, but the patch falls between the quadrature points; enlarge poke.radius or refine the mesh"
