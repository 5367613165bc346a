"""The natural frequencies of a scene, with the shapes that vibrate."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from sdfnet.physics.modes import modes
from sdfnet.physics.plan import Plan
from sdfnet.physics.statics import require_linear


@dataclass(frozen=True, eq=False)
class NaturalModes:
    """Free vibrations u = shape cos(omega t), the slowest first."""

    angular_frequencies: Float64[np.ndarray, " modes"]  # 1/s
    shapes: Float64[np.ndarray, "modes nodes 3"]  # kg^-1/2: the sum of s'Ms is 1 for each, zero on fixed components

    @property
    def frequencies(self) -> Float64[np.ndarray, " modes"]:
        """Natural frequencies, Hz."""
        return self.angular_frequencies / (2 * np.pi)


def natural_frequencies(compiled: Plan, count: int) -> NaturalModes:
    """The `count` slowest vibrations of a scene without loads and damping: K s = omega^2 M s on the free components.

    A row of a shape is a node of `compiled.model.elements`. The mass is the one that `solver.mass` names: consistent comes
    from above, lumped is a little lower. A solid that nothing holds begins with six modes of frequency zero (to the
    root of rounding). Raises ConfigurationError for more modes than free components and for force laws.
    """
    require_linear(compiled, "natural frequencies")
    motion = compiled.equation()
    found = modes(motion.stiffness, motion.mass, count)
    shapes = np.zeros((count, 3 * motion.n_nodes))
    shapes[:, motion.free] = found.shapes.T
    return NaturalModes(found.angular_frequencies, shapes.reshape(count, -1, 3))
