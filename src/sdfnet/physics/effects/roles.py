"""What an effect may need from the simulator, one small role each; an effect derives from those that it needs.

`plan.py` asks for roles and never for a particular effect, so that an effect in any file, a dataset plugin included, is
compiled into the step like those that come with sdfnet. What no effect asks for is not computed.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float64, Int64
from torch import Tensor

from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.effects.history import CONSTANT, History
from sdfnet.physics.elasticity import ElasticModel
from sdfnet.physics.elements import FiniteElements
from sdfnet.scene import Effect, Material

Report = dict[str, float | int | str]


class ConstrainsNodes(Effect, ABC):
    """Holds components of nodes at their rest position."""

    @abstractmethod
    def fixed_components(self, elements: FiniteElements) -> Bool[np.ndarray, "nodes 3"]:
        """True where a node's component does not move. Raises PhysicsError when that is nowhere or everywhere."""


class ChangesMaterial(Effect, ABC):
    """Makes a part of the solid of another material."""

    material: Material

    @abstractmethod
    def tets(self, mesh: TetMesh) -> Bool[np.ndarray, " tets"]:
        """True for the tets that are made of `material`. Raises PhysicsError when none is."""


@dataclass(frozen=True, eq=False)
class Load:
    """A load that does not follow the solid, and what there is to say about it."""

    nodal_force: Float64[np.ndarray, "nodes 3"]  # N
    stress: float = 0.0  # Pa, the stress to expect from it: over a tenth of Young's modulus is outside linear elasticity
    report: Report = field(default_factory=dict)  # goes into the trajectory's report; units in the names
    history: History = CONSTANT  # the factor on nodal_force over time
    is_stress: bool = False  # whether it is a stress of the linear elastic force, which means nothing where another takes its place


class AddsLoad(Effect, ABC):
    """Pushes with a force that the solid's motion does not change."""

    @abstractmethod
    def load(self, model: ElasticModel) -> Load:
        """The nodal force; one in proportion to the mass goes by `model.nodal_mass`. Raises PhysicsError when it would act on nothing."""


@dataclass(frozen=True)
class Damping:
    """C = mass * M + stiffness * K (Rayleigh)."""

    mass: float = 0.0  # 1/s
    stiffness: float = 0.0  # s

    def __bool__(self) -> bool:
        return bool(self.mass != 0 or self.stiffness != 0)  # of NumPy's numbers too, as frequencies are

    def __add__(self, other: "Damping") -> "Damping":
        return Damping(self.mass + other.mass, self.stiffness + other.stiffness)

    def ratio(self, frequency: float) -> float:
        """The damping ratio of a mode of that angular frequency (1/s): 1 is critical."""
        return (self.mass / frequency + self.stiffness * frequency) / 2


class AddsDamping(Effect, ABC):
    """Takes energy out of the motion in proportion to the velocity."""

    @abstractmethod
    def damping(self, model: ElasticModel) -> Damping:
        """The two Rayleigh coefficients."""


@dataclass(frozen=True, eq=False)
class Start:
    """Where the solid is at time 0 and how fast it moves."""

    displacement: Float64[np.ndarray, "nodes 3"]  # m
    velocity: Float64[np.ndarray, "nodes 3"]  # m/s


class SetsStart(Effect, ABC):
    """Gives the solid an initial displacement or velocity; several add up."""

    @abstractmethod
    def start(self, model: ElasticModel) -> Start:
        """The initial state. On fixed components it is left out, with a warning."""


class ForceLaw(ABC):
    """A force that follows the state of the solid and so is computed anew at every step: contact, hyperelasticity.

    Positions are rest position plus displacement. Everything is float64 on the CPU. The force depends on displacement
    and time alone, bit for bit, so that a run can be gone on with.
    """

    stable_fraction: float = 1.0  # part of the step limit at rest that stays safe while the force stiffens
    is_driven: bool = False  # whether something moves it from outside: it then says its `drive_work` too

    @abstractmethod
    def force(self, displacement: Float64[Tensor, "nodes 3"], time: float) -> Float64[Tensor, "nodes 3"]:
        """The nodal force, N, at a time in s. May be overwritten by the next call."""

    @abstractmethod
    def stored_energy(self, displacement: Float64[Tensor, "nodes 3"], time: float) -> float:
        """The potential whose negative gradient is the force, J; zero at rest."""

    def drive_work(self, force: Float64[Tensor, "nodes 3"], start: float, end: float) -> float:
        """What drives the law puts in between two times (s) while it exerts this nodal force, J: the stored energy's growth with the solid held still."""
        return 0.0

    @abstractmethod
    def added_stiffness(self) -> Float64[np.ndarray, " nodes"]:
        """The most that a node's force can change per metre in excess of the linear stiffness, N/m: the step limit counts it."""

    def report(self, displacement: Float64[np.ndarray, "frames nodes 3"], times: Float64[np.ndarray, " frames"]) -> Report:
        """What there is to say after a run: penetrations, resultants; units in the names."""
        return {}


class ConservingLaw(ForceLaw):
    """A force law that looks a step ahead, so that it does exactly the work that its stored energy loses, however stiff it is.

    From displacement a, a step ago, to b, a step ahead, it is the mean slope of its potential U: f . (b - a) = U(a) - U(b).
    So it shortens no step and its `added_stiffness` is zero. It needs a lumped mass.
    """

    nodes: Int64[np.ndarray, " contacts"]  # on which it may act

    @abstractmethod
    def force_over_step(
        self, before: Float64[Tensor, "contacts 3"], ahead: Float64[Tensor, "contacts 3"], mobility: Float64[Tensor, "contacts 3"]
    ) -> Float64[Tensor, "contacts 3"] | None:
        """The force on `nodes`, N, that takes `before`, a step ago, to `ahead` + mobility * force. None when it is zero.

        `mobility` is in m/N, zero for fixed components, whose force does not count.
        """


class FollowsState(Effect, ABC):
    """Needs a new force at every step."""

    @abstractmethod
    def force_law(self, model: ElasticModel, fixed: Bool[np.ndarray, "nodes 3"]) -> ForceLaw | None:
        """The force, beside the linear elastic one; `fixed` components do not move. None when it comes to nothing."""


class ReplacesElasticity(Effect, ABC):
    """Takes the place of the linear elastic force; a scene may hold one."""

    @abstractmethod
    def elastic_law(self, model: ElasticModel) -> ForceLaw:
        """The elastic force. Its tangent at rest must be the linear stiffness, which the step limit is taken from."""
