"""Weight."""

from dataclasses import dataclass, field

import numpy as np

from sdfnet.errors import ConfigurationError
from sdfnet.physics.effects.history import History
from sdfnet.physics.effects.roles import AddsLoad, Load
from sdfnet.physics.elasticity import ElasticModel


@dataclass(frozen=True)
class Gravity(AddsLoad):
    """f = M g in N, with g `acceleration` in m/s^2: in sum rho g on every m^3 of the volume.

    With the consistent mass, and with linear tets, M g is the integral of rho g v, under which a solid sags as it should.
    The lumped mass of quadratic tets takes other shares. Where an effect holds nodes M is the consistent mass, whatever
    `solver.mass` is; where none does it is the mass that moves, so that a free solid falls without deforming. Between
    the two, by a part of h^2 with h the edge of a cell: lumped quadratic tets that slide freely on rollers quiver, and
    those that `FloorContact` alone carries sag unevenly; there take `solver.mass=consistent`.

    For a solid that sags, hangs or falls: where rho g L, L its extent along g, is no small part of Young's modulus or of
    the other loads' pressure. Switched on at time 0 it makes the solid swing to twice its sag; a `history` that rises
    slowly lets it settle. Not for the paper's scene, where rho g L is 3e-4 of Young's modulus and the poke's pressure 0.8.
    """

    acceleration: tuple[float, float, float] = (0.0, 0.0, -9.81)  # m/s^2
    history: History = field(default_factory=History)  # the factor on the acceleration over time

    def __post_init__(self) -> None:
        super().__post_init__()
        if not np.isfinite(self.acceleration).all():
            raise ConfigurationError(f"gravity.acceleration must be finite, found {tuple(self.acceleration)} m/s^2")

    def load(self, model: ElasticModel) -> Load:
        """The nodal force, with the weight in N and rho g L in Pa, the stress under a column as long as the solid."""
        acceleration = np.asarray(self.acceleration, dtype=np.float64)
        nodal_force = model.nodal_mass[:, None] * acceleration
        # g times the extent along g, so that no direction is needed where g is zero.
        potential = float(np.ptp(model.mesh.nodes @ acceleration))
        stress = float(np.max(model.material.density)) * potential
        return Load(nodal_force, stress, {"weight_N": float(np.linalg.norm(nodal_force.sum(axis=0))), "rho_g_length_Pa": stress}, self.history)
