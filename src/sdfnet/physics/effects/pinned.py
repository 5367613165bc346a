"""Nodes that are held: the bunny's foot on the floor, the wall end of a beam."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool

from sdfnet.errors import ConfigurationError, PhysicsError
from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.effects.roles import ConstrainsNodes

ROUNDING = 1e-9  # of the diagonal: a node this little beyond the plane was meant to lie on it


@dataclass(frozen=True)
class Pinned(ConstrainsNodes):
    """Holds the nodes on or behind a plane: (x - point) . normal <= 0 (paper section 2: u = 0 where z <= 0).

    With fewer `components` than three it is a roller; with `boundary_only` off it holds nodes inside the solid too.
    """

    point: tuple[float, float, float] = (0.0, 0.0, 0.0)  # m, on the plane
    normal: tuple[float, float, float] = (0.0, 0.0, 1.0)  # points to the free side; its length does not matter
    components: tuple[bool, bool, bool] = (True, True, True)  # which of x, y, z are held
    boundary_only: bool = True

    def __post_init__(self) -> None:
        if not (np.isfinite(self.normal).all() and np.any(self.normal)):
            raise ConfigurationError(f"pinned.normal must be finite and not zero, found {tuple(self.normal)}")
        if not any(self.components):
            raise ConfigurationError("pinned.components must hold at least one of x, y, z, found none; remove the effect instead")

    def fixed_components(self, mesh: TetMesh) -> Bool[np.ndarray, "nodes 3"]:
        """True for the held components of the nodes behind the plane.

        Raises PhysicsError when no node is behind it, or when every candidate is and all three components are held.
        """
        candidates = mesh.surface_nodes if self.boundary_only else np.arange(len(mesh.nodes))
        normal = np.asarray(self.normal, dtype=np.float64)
        heights = (mesh.nodes[candidates] - np.asarray(self.point, dtype=np.float64)) @ (normal / np.linalg.norm(normal))
        held = heights <= ROUNDING * mesh.diagonal
        where = f"heights over the plane through {tuple(self.point)} m with normal {tuple(self.normal)} run from {heights.min():.3g} to {heights.max():.3g} m"
        if not held.any():
            raise PhysicsError(f"a pinned effect must hold at least one node, found none: {where}; move pinned.point")
        if held.all() and all(self.components):
            raise PhysicsError(f"a pinned effect must leave a node free, found all {len(candidates)} held: {where}; move pinned.point or turn pinned.normal")
        fixed = np.zeros((len(mesh.nodes), 3), dtype=np.bool_)
        fixed[candidates[held]] = self.components
        return fixed
