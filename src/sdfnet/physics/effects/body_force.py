"""A force on every part of the volume: the paper's external force field f."""

from dataclasses import dataclass, field

import numpy as np

from sdfnet.errors import ConfigurationError
from sdfnet.physics.effects.history import History
from sdfnet.physics.effects.roles import AddsLoad, Load
from sdfnet.physics.elasticity import ElasticModel, body_force


@dataclass(frozen=True)
class BodyForce(AddsLoad):
    """Nodal force = integral of f v in N, with f in N/m^3 the same on every part of the volume (paper section 2; zero in its scene).

    For a solid in a field that acts on its volume, such as a magnetic one. Not for weight, for which
    there is `Gravity`. It does not go by the mass: a free solid of lumped quadratic tets quivers under it.
    """

    density: tuple[float, float, float]  # N/m^3
    history: History = field(default_factory=History)  # the factor on the density over time

    def __post_init__(self) -> None:
        super().__post_init__()
        if not np.isfinite(self.density).all():
            raise ConfigurationError(f"body_force.density must be finite, found {tuple(self.density)} N/m^3")

    def load(self, model: ElasticModel) -> Load:
        """The nodal force; the stress to expect is that of a column as long as the solid's diagonal."""
        density = np.asarray(self.density, dtype=np.float64)
        nodal_force = body_force(model.elements, density)
        resultant = float(np.linalg.norm(nodal_force.sum(axis=0)))
        return Load(nodal_force, float(np.linalg.norm(density)) * model.mesh.diagonal, {"resultant_N": resultant}, self.history)
