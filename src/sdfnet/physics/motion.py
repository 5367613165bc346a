"""The equation of motion that a scene comes to: what the integrators integrate."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Float64, Int64
from scipy.sparse import csr_matrix
from torch import Tensor

from sdfnet.physics.effects.history import History
from sdfnet.physics.effects.roles import Damping, ForceLaw
from sdfnet.physics.mass import Mass

TICK_ULPS = 4  # units in the last place: times so near are one, and pieces of a regular table so many ticks or one more, a few lengths in all


@dataclass(frozen=True, eq=False)
class TimedLoad:
    """A load whose strength changes with time: factor(t) * force."""

    force: Float64[np.ndarray, "dofs columns"]  # N
    history: History


@dataclass(frozen=True, eq=False)
class NodePlaces:
    """Where the components of some nodes are among the free degrees of freedom."""

    index: Int64[Tensor, " components"]  # three for each node; zero for fixed ones
    is_free: Float64[Tensor, "nodes 3"]  # one or zero

    def of(self, values: Float64[Tensor, "dofs columns"]) -> Float64[Tensor, "nodes 3"]:
        """The first column on the nodes, zero where fixed."""
        return values[:, 0].index_select(0, self.index).view(-1, 3).mul_(self.is_free)


@dataclass(frozen=True, eq=False)
class EquationOfMotion:
    """M a + C v + K u = f + sum of factor(t) f_k + forces that follow the state, on the free degrees of freedom.

    A column is a load case. K is without entries where a hyperelastic law takes its place. What no effect asked for is
    empty here and costs nothing.
    """

    mass: Mass
    stiffness: csr_matrix  # N/m
    constant_force: Float64[np.ndarray, "dofs columns"]  # N
    timed_loads: tuple[TimedLoad, ...]
    damping: Damping
    laws: tuple[ForceLaw, ...]
    displacement: Float64[np.ndarray, "dofs columns"]  # m, at time 0
    velocity: Float64[np.ndarray, "dofs columns"]  # m/s, at time 0
    free: Int64[np.ndarray, " dofs"]  # which of the 3 * nodes components are free
    n_nodes: int

    def force_of(self, factors: Sequence[float]) -> Float64[np.ndarray, "dofs columns"]:
        """All loads that do not follow the state, N, with so much of each timed one."""
        force = self.constant_force
        for factor, load in zip(factors, self.timed_loads, strict=True):
            force = force + factor * load.force
        return force

    def straight_pieces(self, start: float, span: float) -> Iterator[tuple[float, list[float], list[float]]]:
        """A span of time cut where a timed load bends: how long each piece takes (s), and the factors at its beginning and its end."""
        histories, end = [load.history for load in self.timed_loads], start + span
        bends = [bend for history in histories for bend in history.bends(start, end)]
        if not bends:
            yield span, [history.factor(start) for history in histories], [history.factor(end) for history in histories]
            return
        tick = TICK_ULPS * np.spacing(end)
        cuts = np.unique(np.rint(np.array([start, *bends, end]) / tick)) * tick
        for begin, length in zip(cuts[:-1], np.diff(cuts), strict=True):
            # From within, because a rise that takes less than a tick is a jump at one of the ends.
            early, late = (np.array([history.factor(begin + share * length) for history in histories]) for share in (0.25, 0.75))
            yield float(length), list(1.5 * early - 0.5 * late), list(1.5 * late - 0.5 * early)

    def energy(self, displacement: Float64[np.ndarray, "dofs columns"], velocity: Float64[np.ndarray, "dofs columns"]) -> Float64[np.ndarray, " columns"]:
        """1/2 v'Mv + 1/2 u'Ku - f'u, with f the constant load, J: kept by the exact motion where only constant loads act."""
        kinetic = 0.5 * (velocity * self.mass.product(velocity)).sum(axis=0)
        result: np.ndarray = kinetic + (displacement * (0.5 * (self.stiffness @ displacement) - self.constant_force)).sum(axis=0)
        return result

    def nodal(self, values: Float64[Tensor, "dofs columns"]) -> Float64[Tensor, "nodes 3"]:
        """The first column on all nodes, zero where fixed."""
        return torch.zeros(3 * self.n_nodes, dtype=torch.float64).index_copy_(0, self._free_index, values[:, 0]).view(-1, 3)

    def on_free(self, nodal: Float64[Tensor, "nodes 3"]) -> Float64[Tensor, "dofs 1"]:
        """What all nodes have as a column on the free degrees of freedom."""
        return nodal.reshape(-1).index_select(0, self._free_index)[:, None]

    def places(self, nodes: Int64[np.ndarray, " nodes"]) -> NodePlaces:
        """Where the components of these nodes are."""
        position = np.full((self.n_nodes, 3), -1)
        position.reshape(-1)[self.free] = np.arange(len(self.free))
        chosen = position[nodes]
        return NodePlaces(torch.from_numpy(np.maximum(chosen, 0).ravel()), torch.from_numpy((chosen >= 0).astype(np.float64)))

    @property
    def is_conservative(self) -> bool:
        """Whether only constant loads act, so that the energy is kept."""
        return not (self.laws or self.timed_loads or self.damping)

    @cached_property
    def _free_index(self) -> Tensor:
        return torch.from_numpy(self.free)
