"""A strain that the solid would have without any stress: heat, swelling, shrinkage."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float64

from sdfnet.errors import ConfigurationError
from sdfnet.physics.effects.history import History
from sdfnet.physics.effects.roles import AddsLoad, Load
from sdfnet.physics.elasticity import ElasticModel, stress_load
from sdfnet.physics.materials import per_tet

COMPONENTS = ((0, 1, 2, 1, 0, 0), (0, 1, 2, 2, 2, 1))  # rows and columns of xx, yy, zz, yz, xz, xy


@dataclass(frozen=True)
class Prestrain(AddsLoad):
    """sigma = C : (epsilon - epsilon0) in Pa, with epsilon0 = strain + expansion_coefficient * temperature_change * I.

    It is the load f = integral of C : epsilon0 : grad v in N, the same everywhere in the solid. What is free comes to
    rest at u = epsilon0 x without stress; what is held comes under stress. For a solid that is warmed, dries, swells or
    grows. Not for heat that differs from place to place or flows, not for strains over a tenth, and not with finite
    strain, whose force it does not enter.
    """

    strain: tuple[float, float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)  # 1, the tensor's xx, yy, zz, yz, xz, xy: half of a shear angle
    expansion_coefficient: float = 0.0  # 1/K, along a line
    temperature_change: float = 0.0  # K
    history: History = field(default_factory=History)  # the factor on epsilon0 over time

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, unit in (("strain", ""), ("expansion_coefficient", " 1/K"), ("temperature_change", " K")):
            if not np.isfinite(getattr(self, name)).all():
                raise ConfigurationError(f"prestrain.{name} must be finite, found {getattr(self, name)}{unit}")

    @property
    def tensor(self) -> Float64[np.ndarray, "3 3"]:
        """epsilon0."""
        result = self.expansion_coefficient * self.temperature_change * np.eye(3)
        rows, columns = COMPONENTS
        result[rows, columns] += self.strain
        result[columns[3:], rows[3:]] = result[rows[3:], columns[3:]]
        return result

    def load(self, model: ElasticModel) -> Load:
        """The nodal force, with the largest principal strain and the stress that it would be where nothing may move.

        The stress to expect is strain times Young's modulus: a strain, not a stress, is what linear elasticity bears.
        """
        strain, material = self.tensor, model.material
        stress = per_tet(material.lame_lambda, 2) * np.trace(strain) * np.eye(3) + 2 * per_tet(material.lame_mu, 2) * strain
        largest, held = (float(np.abs(np.linalg.eigvalsh(tensor)).max()) for tensor in (strain, stress))
        report: dict[str, float | int | str] = {"largest_strain": largest, "stress_if_held_Pa": held}
        return Load(stress_load(model.elements, stress), largest * float(np.min(material.youngs_modulus)), report, self.history, is_stress=True)
