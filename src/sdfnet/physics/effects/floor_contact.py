"""A floor that the solid may fall on, rest on and lift off from."""

import logging
import math
from dataclasses import dataclass
from typing import final

import numpy as np
import torch
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from sdfnet.errors import ConfigurationError, PhysicsError
from sdfnet.physics.effects.contact import LARGEST_PENETRATION, check_factor, penalty, unit, wave_moduli
from sdfnet.physics.effects.roles import ConservingLaw, FollowsState, ForceLaw, Report
from sdfnet.physics.elasticity import ElasticModel

logger = logging.getLogger(__name__)

ROUNDING = 1e-9  # of the diagonal: a node so little under the floor was meant to lie on it


@dataclass(frozen=True)
class FloorContact(FollowsState):
    """f_i = k_i max(0, depth_i) normal in N, on every surface node i, with depth = height - x . normal in m.

    k_i = stiffness_factor (lambda + 2 mu) area_i / edge_i in N/m, from the node's share of the surface and the edges
    around it: a penalty, so the solid sinks in a little, in proportion to 1/stiffness_factor, and the report says how
    far. The floor only pushes: no adhesion and no friction. It takes no energy and gives none, to rounding and at any
    step, and so asks for no smaller step; it needs a lumped mass. Nodes that are held do not count.
    For a solid that is dropped, or tips over onto what it stands on. Not for a foot that stays on the floor: pin it,
    which costs nothing. Not for parts of the solid that touch each other.
    """

    height: float = 0.0  # m, of the floor along the normal from the origin
    normal: tuple[float, float, float] = (0.0, 0.0, 1.0)  # up from the floor; its length does not matter
    stiffness_factor: float = 10.0  # 1: the floor gives way like a layer of the solid's own tets; more sinks in less

    def __post_init__(self) -> None:
        super().__post_init__()
        if not math.isfinite(self.height):
            raise ConfigurationError(f"floor.height must be finite, found {self.height} m")
        unit("floor.normal", self.normal)
        check_factor("floor", self.stiffness_factor)

    def force_law(self, model: ElasticModel, fixed: Bool[np.ndarray, "nodes 3"]) -> ForceLaw | None:
        """The floor's force on the nodes of the surface that may move along the normal.

        Raises PhysicsError when one of them lies under the floor at rest.
        """
        if self.stiffness_factor == 0:
            return None
        normal = unit("floor.normal", self.normal)
        is_held = (fixed | (normal == 0)).all(axis=1)
        nodes = np.flatnonzero(model.elements.is_on_boundary & ~is_held)
        heights = model.elements.nodes[nodes] @ normal
        gaps = heights - self.height
        if len(nodes) and gaps.min() < -ROUNDING * model.mesh.diagonal:
            raise PhysicsError(self._starts_under(model, nodes, gaps, float(heights.min())))
        faces, pushes = model.elements.boundary_faces, penalty(model, self.stiffness_factor)
        corners = faces.shape[1]
        stiffness = np.bincount(faces.ravel(), np.repeat(pushes.stiffness * pushes.areas / corners, corners), minlength=len(fixed))
        moduli = wave_moduli(model)
        stiffest = float(moduli.max())
        areas = np.bincount(
            faces.ravel(), np.repeat(pushes.areas * (moduli / stiffest) / corners, corners), minlength=len(fixed)
        )  # of one modulus, as pushes.areas
        edges = self.stiffness_factor * stiffest * areas[nodes] / stiffness[nodes]
        return Floor(len(fixed), nodes, np.maximum(gaps, 0.0), normal, stiffness[nodes], edges)

    def _starts_under(self, model: ElasticModel, nodes: np.ndarray, gaps: np.ndarray, lowest: float) -> str:
        x, y, z = model.elements.nodes[nodes[gaps.argmin()]]
        return (
            f"a solid must start on or over the floor at {self.height:.4g} m, found {int((gaps < 0).sum())} free nodes of its surface under it, "
            f"the deepest by {-gaps.min():.4g} m at ({x:.4g}, {y:.4g}, {z:.4g}) m; pin them, or set floor.height to {lowest:.6g} or lower"
        )


@final
class Floor(ConservingLaw):
    """The penalty of a plane on the nodes of a surface. Its potential is 1/2 k depth^2 of every node under it, J.

    With depths a a step ago and b a step ahead the force on a node is f = (U(b) - U(a)) / (b - a), and b = s - c f where
    s is the depth without the floor and c what a newton moves the node. With lumped masses that is an equation for
    each node alone, at most quadratic, with one solution (after Laursen and Chawla 1997).
    """

    def __init__(
        self,
        n_nodes: int,
        nodes: Int64[np.ndarray, " contacts"],
        gaps: Float64[np.ndarray, " contacts"],
        normal: Float64[np.ndarray, "3"],
        stiffness: Float64[np.ndarray, " contacts"],
        edges: Float64[np.ndarray, " contacts"],
    ) -> None:
        self.nodes, self._index, self._edges = nodes, torch.from_numpy(nodes), torch.from_numpy(edges)
        self._gaps, self._stiffness, self._normal = torch.from_numpy(gaps), torch.from_numpy(stiffness), torch.from_numpy(normal)
        self._force = torch.zeros(n_nodes, 3, dtype=torch.float64)

    def force(self, displacement: Float64[Tensor, "nodes 3"], time: float) -> Float64[Tensor, "nodes 3"]:
        """k depth along the normal, N."""
        pushes = self._stiffness * self._depths(displacement).clamp(min=0.0)
        return self._force.index_copy_(0, self._index, pushes[:, None] * self._normal)

    def force_over_step(
        self, before: Float64[Tensor, "contacts 3"], ahead: Float64[Tensor, "contacts 3"], mobility: Float64[Tensor, "contacts 3"]
    ) -> Float64[Tensor, "contacts 3"] | None:
        """The mean force of the floor on each node, N."""
        a, s = -self._gaps - before @ self._normal, -self._gaps - ahead @ self._normal
        touching = (torch.maximum(a, s) > 0).nonzero()[:, 0]
        if len(touching) == 0:
            return None
        c = mobility[touching] @ self._normal**2
        b = _depth_ahead(a[touching], s[touching], c * self._stiffness[touching] / 2)
        return torch.zeros_like(ahead).index_copy_(0, touching, ((s[touching] - b) / c)[:, None] * self._normal)

    def stored_energy(self, displacement: Float64[Tensor, "nodes 3"], time: float) -> float:
        """Sum of 1/2 k depth^2, J."""
        return float(0.5 * (self._stiffness * self._depths(displacement).clamp(min=0.0) ** 2).sum())

    def added_stiffness(self) -> Float64[np.ndarray, " nodes"]:
        """None."""
        return np.zeros(len(self._force))

    def report(self, displacement: Float64[np.ndarray, "frames nodes 3"], times: Float64[np.ndarray, " frames"]) -> Report:
        """How far the solid sinks in and how hard the floor pushes, over the recorded frames; warns when it is far."""
        depths = torch.stack([self._depths(torch.from_numpy(frame)) for frame in displacement]).clamp(min=0.0)
        share = float((depths / self._edges).max())
        if share > LARGEST_PENETRATION:
            logger.warning("the solid sinks into the floor by %.2g of an edge; raise floor.stiffness_factor or refine the mesh", share)
        return {
            "frames_in_contact": int((depths > 0).any(dim=1).sum()),
            "largest_penetration_m": float(depths.max()),
            "largest_penetration_per_edge": share,
            "largest_force_N": float((depths @ self._stiffness).max()),
        }

    def _depths(self, displacement: Float64[Tensor, "nodes 3"]) -> Float64[Tensor, " contacts"]:
        """How far each node is under the floor, m; negative over it."""
        return -self._gaps - displacement.index_select(0, self._index) @ self._normal


def _depth_ahead(a: Float64[Tensor, " contacts"], s: Float64[Tensor, " contacts"], g: Float64[Tensor, " contacts"]) -> Float64[Tensor, " contacts"]:
    """b of b + 2 g (U(b) - U(a)) / (k (b - a)) = s with U = 1/2 k max(0, depth)^2, where a or s is positive and g = c k / 2.

    Both under the floor: b + g (b + a) = s. Leaving: b^2 - (a + s) b + a (s - g a) = 0, the root that is not positive.
    Entering: (1 + g) b^2 - (a + s) b + a s = 0, the root that is not negative.
    """
    stays = (s - g * a) / (1 + g)
    leaves = ((a + s) - torch.sqrt((a - s) ** 2 + 4 * g * a**2)) / 2
    enters = ((a + s) + torch.sqrt(((a + s) ** 2 - 4 * (1 + g) * a * s).clamp(min=0.0))) / (2 * (1 + g))  # under the root negative only where it is not used
    return torch.where(a > 0, torch.where(stays >= 0, stays, leaves), enters)
