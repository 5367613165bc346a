"""A force on a part of the surface: the end of a beam that is pulled, a wall under water."""

import math
from dataclasses import dataclass, field

import numpy as np

from sdfnet.errors import ConfigurationError, PhysicsError
from sdfnet.physics.effects.history import History
from sdfnet.physics.effects.roles import AddsLoad, Load
from sdfnet.physics.elasticity import ElasticModel
from sdfnet.physics.loads import PatchTraction, traction_on_patch
from sdfnet.physics.regions import ROUNDING, BoxRegion, Region


@dataclass(frozen=True)
class Traction(AddsLoad):
    """t = traction - pressure n in Pa on the surface inside a region, n its outward normal: f = integral of t v dS in N.

    For a pulled or sheared end, a wind, water around a solid. The region's indicator is integrated, so that it may end
    within a face. By default it is all of the surface. Not for a finger, which `PressurePoke` says in fewer words, and
    not for a pressure that should follow the surface as it turns: direction and area are those at rest.
    """

    region: Region = field(default_factory=BoxRegion)
    traction: tuple[float, float, float] = (0.0, 0.0, 0.0)  # Pa, along x, y and z
    pressure: float = 0.0  # Pa, against the outward normal; negative pulls
    history: History = field(default_factory=History)  # the factor on both over time

    def __post_init__(self) -> None:
        super().__post_init__()
        if not np.isfinite(self.traction).all():
            raise ConfigurationError(f"traction.traction must be finite, found {tuple(self.traction)} Pa")
        if not math.isfinite(self.pressure):
            raise ConfigurationError(f"traction.pressure must be finite, found {self.pressure} Pa")

    def load(self, model: ElasticModel) -> Load:
        """The nodal force, with the loaded area and the resultant. Raises PhysicsError when none of the surface is in the region."""
        vector = np.asarray(self.traction, dtype=np.float64)
        size = float(np.linalg.norm(vector))
        patch = self._on_patch(model, size, vector / size) if size else self._on_patch(model, self.pressure, None)
        if patch.area == 0:
            surface = model.elements.nodes[model.elements.is_on_boundary]
            raise PhysicsError(
                f"a traction must load some of the surface, found none: {self.region.beside(surface)}; move or enlarge traction.region, or refine the mesh"
            )
        nodal_force = patch.nodal_force + self._on_patch(model, self.pressure, None).nodal_force if size and self.pressure else patch.nodal_force
        resultant = float(np.linalg.norm(nodal_force.sum(axis=0)))
        return Load(nodal_force, size + abs(self.pressure), {"loaded_area_m2": patch.area, "resultant_N": resultant}, self.history)

    def _on_patch(self, model: ElasticModel, size: float, direction: np.ndarray | None) -> PatchTraction:
        tolerance, corners = ROUNDING * model.mesh.diagonal, model.mesh.nodes[model.mesh.boundary_faces]
        middles = corners.mean(axis=1)
        reach = float(np.linalg.norm(corners - middles[:, None], axis=2).max())
        near = self.region.may_reach(middles, reach + tolerance)
        return traction_on_patch(model.elements, size, lambda points: self.region.contains(points, tolerance), direction, near)
