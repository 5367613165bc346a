"""A solid that is let go in motion."""

from dataclasses import dataclass, field

import numpy as np

from sdfnet.errors import ConfigurationError, PhysicsError
from sdfnet.physics.effects.roles import SetsStart, Start
from sdfnet.physics.elasticity import ElasticModel
from sdfnet.physics.regions import ROUNDING, BoxRegion, Region


@dataclass(frozen=True)
class InitialMotion(SetsStart):
    """v(0) = velocity + angular_velocity x (x - center) in m/s for the nodes in a region, by default all; u(0) = 0 m.

    For a solid that is thrown, dropped or struck. A region that ends within the solid tears at it: the jump starts waves
    as short as an element, of which the mesh shows nothing true. Not for a motion that is driven on, which is a load
    with a history or a rigid finger; nor for turning by more than some degrees without finite strain, because linear
    elasticity takes a rotation for a strain.
    """

    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)  # m/s
    angular_velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)  # 1/s, radians; right-handed
    center: tuple[float, float, float] | None = None  # m, a point on the axis; none: the solid's centre of mass
    region: Region = field(default_factory=BoxRegion)

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, unit in (("velocity", "m/s"), ("angular_velocity", "1/s"), ("center", "m")):
            value = getattr(self, name)
            if value is not None and not np.isfinite(value).all():
                raise ConfigurationError(f"initial_motion.{name} must be finite, found {tuple(value)} {unit}")

    def start(self, model: ElasticModel) -> Start:
        """The velocities. Raises PhysicsError when no node is in the region."""
        nodes, masses = model.elements.nodes, model.lumped_mass
        moves = self.region.contains(nodes, ROUNDING * model.mesh.diagonal)
        if not moves.any():
            raise PhysicsError(f"an initial motion must move at least one node, found none: {self.region.beside(nodes)}; move or enlarge initial_motion.region")
        center = masses @ nodes / masses.sum() if self.center is None else np.asarray(self.center, dtype=np.float64)
        rotation = np.cross(np.asarray(self.angular_velocity, dtype=np.float64), nodes - center)
        velocity = np.asarray(self.velocity, dtype=np.float64) + rotation
        return Start(np.zeros_like(nodes), np.where(moves[:, None], velocity, 0.0))
