"""What an effect may need from the simulator, one small role each; an effect derives from those that it needs.

`simulate.py` asks for roles and never for a particular effect, so that an effect in any file, a dataset plugin
included, is compiled into the step like those that come with sdfnet. What no effect asks for is not computed.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float64

from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.elasticity import ElasticModel
from sdfnet.scene import Effect


class ConstrainsNodes(Effect, ABC):
    """Holds components of nodes at their rest position."""

    @abstractmethod
    def fixed_components(self, mesh: TetMesh) -> Bool[np.ndarray, "nodes 3"]:
        """True where a node's component does not move. Raises PhysicsError when that is nowhere or everywhere."""


@dataclass(frozen=True, eq=False)
class Load:
    """A load that does not change with time, and what there is to say about it."""

    nodal_force: Float64[np.ndarray, "nodes 3"]  # N
    stress: float = 0.0  # Pa, the stress to expect from it: over a tenth of Young's modulus is outside linear elasticity
    report: dict[str, float | int | str] = field(default_factory=dict)  # goes into the trajectory's report; units in the names


class AddsLoad(Effect, ABC):
    """Pushes with a force that does not change with time."""

    @abstractmethod
    def load(self, model: ElasticModel) -> Load:
        """The constant nodal force. Raises PhysicsError when it would act on nothing."""
