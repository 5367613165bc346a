"""A force on every part of the volume: the paper's external force field f."""

from dataclasses import dataclass

import numpy as np

from sdfnet.errors import ConfigurationError
from sdfnet.physics.effects.roles import AddsLoad, Load
from sdfnet.physics.elasticity import ElasticModel, body_force


@dataclass(frozen=True)
class BodyForce(AddsLoad):
    """A constant force density, such as weight or a steady acceleration (paper section 2, f; zero in its scene)."""

    density: tuple[float, float, float]  # N/m^3

    def __post_init__(self) -> None:
        if not (np.isfinite(self.density).all() and np.any(self.density)):
            raise ConfigurationError(f"body_force.density must be finite and not zero, found {tuple(self.density)} N/m^3; remove the effect for no force")

    def load(self, model: ElasticModel) -> Load:
        """The nodal force; the stress to expect is that of a column as long as the solid's diagonal."""
        density = np.asarray(self.density, dtype=np.float64)
        nodal_force = body_force(model.mesh, density)
        resultant = float(np.linalg.norm(nodal_force.sum(axis=0)))
        return Load(nodal_force, float(np.linalg.norm(density)) * model.mesh.diagonal, {"resultant_N": resultant})
