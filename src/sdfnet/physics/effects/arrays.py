"""Effects given as one row per node, for scenes that are built in code: constraints, forces, initial states.

A row is a node of the elements: `sdfnet.physics.elasticity.finite_elements(mesh, element).nodes`, which for P1 are the
nodes of the mesh and for P2 the middles of the edges besides. Arrays are no settings: these effects cannot be named on
the command line. Not for scenes that should outlive their mesh; choose nodes by a region there.
"""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float64

from sdfnet.errors import PhysicsError
from sdfnet.physics.effects.history import History
from sdfnet.physics.effects.roles import AddsLoad, ConstrainsNodes, Load, SetsStart, Start
from sdfnet.physics.elasticity import ElasticModel
from sdfnet.physics.elements import FiniteElements


class _ComparedByIdentity:
    """Arrays have no one truth value. Without this the comparison of `Effect`, which has no fields, would find all of a kind equal."""

    __eq__ = object.__eq__
    __hash__ = object.__hash__


@dataclass(frozen=True, eq=False)
class FixedComponents(_ComparedByIdentity, ConstrainsNodes):
    """Holds components of single nodes at their rest position: u_i = 0 where `mask` is true, in m."""

    mask: Bool[np.ndarray, "nodes 3"]

    def fixed_components(self, elements: FiniteElements) -> Bool[np.ndarray, "nodes 3"]:
        """The mask. Raises PhysicsError when it is of another shape or true nowhere."""
        _require_row_per_node("fixed_components.mask", self.mask, elements)
        if not self.mask.any():
            raise PhysicsError("fixed_components.mask must hold at least one component, found none; remove the effect instead")
        return self.mask


@dataclass(frozen=True, eq=False)
class NodalForce(_ComparedByIdentity, AddsLoad):
    """Forces on single nodes, f_i = factor(t) * force, in N.

    A force on one node is a force on less and less surface as the mesh is refined, and its stress grows without limit:
    for anything but comparison with a textbook take a traction.
    """

    force: Float64[np.ndarray, "nodes 3"]  # N
    history: History = field(default_factory=History)  # the factor on the force over time

    def load(self, model: ElasticModel) -> Load:
        """The force. Raises PhysicsError when it is of another shape or not finite."""
        _require_row_per_node("nodal_force.force", self.force, model.elements)
        return Load(self.force, report={"resultant_N": float(np.linalg.norm(self.force.sum(axis=0)))}, history=self.history)


@dataclass(frozen=True, eq=False)
class NodalStart(_ComparedByIdentity, SetsStart):
    """u(0) in m and v(0) in m/s of every node; what is None is zero."""

    displacement: Float64[np.ndarray, "nodes 3"] | None = None  # m
    velocity: Float64[np.ndarray, "nodes 3"] | None = None  # m/s

    def start(self, model: ElasticModel) -> Start:
        """The two arrays. Raises PhysicsError when one is of another shape or not finite."""
        given = {"displacement": self.displacement, "velocity": self.velocity}
        arrays = {name: np.zeros_like(model.elements.nodes) if values is None else values for name, values in given.items()}
        for name, values in arrays.items():
            _require_row_per_node(f"nodal_start.{name}", values, model.elements)
        return Start(**arrays)


def _require_row_per_node(name: str, values: np.ndarray, elements: FiniteElements) -> None:
    expected = elements.nodes.shape
    if values.shape != expected:
        raise PhysicsError(
            f"{name} must have shape {expected}, a row for each node of the {elements.element} elements, found {values.shape}; "
            "make it from sdfnet.physics.elasticity.finite_elements(mesh, element).nodes"
        )
    bad = np.flatnonzero(~np.isfinite(values).all(axis=1))
    if len(bad):
        raise PhysicsError(f"{name} must be finite, found {len(bad)} rows that are not, the first at index {bad[0]}; mend them")
