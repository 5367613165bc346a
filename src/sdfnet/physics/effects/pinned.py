"""Nodes that are held: the bunny's foot on the floor, the wall end of a beam."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool

from sdfnet.errors import ConfigurationError, PhysicsError
from sdfnet.physics.effects.roles import ConstrainsNodes
from sdfnet.physics.elements import FiniteElements
from sdfnet.physics.regions import ROUNDING, HalfSpace, Region


@dataclass(frozen=True)
class Pinned(ConstrainsNodes):
    """Holds the nodes in a region of the rest state: u = 0 m (paper section 2, where z <= 0).

    For a solid that is glued, clamped or cast in. With fewer `components` than three it is a roller; with
    `boundary_only` off it holds nodes inside the solid too. Not for a solid that only lies on a floor and could lift off
    or slide: take a floor contact there.
    """

    region: Region = field(default_factory=HalfSpace)
    components: tuple[bool, bool, bool] = (True, True, True)  # which of x, y, z are held
    boundary_only: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        if not any(self.components):
            raise ConfigurationError("pinned.components must hold at least one of x, y, z, found none; remove the effect instead")

    def fixed_components(self, elements: FiniteElements) -> Bool[np.ndarray, "nodes 3"]:
        """True for the held components of the nodes in the region.

        Raises PhysicsError when no node is in it, or when every candidate is and all three components are held.
        """
        candidates = elements.is_on_boundary if self.boundary_only else np.ones(len(elements.nodes), dtype=np.bool_)
        held = candidates & self.region.contains(elements.nodes, ROUNDING * elements.mesh.diagonal)
        if not held.any():
            where = self.region.beside(elements.nodes[candidates])
            raise PhysicsError(f"a pinned effect must hold at least one node, found none: {where}; move or enlarge pinned.region")
        if (held == candidates).all() and all(self.components):
            where = self.region.beside(elements.nodes[candidates])
            raise PhysicsError(f"a pinned effect must leave a node free, found all {int(held.sum())} held: {where}; shrink or turn pinned.region")
        return held[:, None] & np.asarray(self.components)
