"""What every time integrator promises. A new one is one file, registered in `integrators/__init__.py`."""

import warnings
from abc import ABC, abstractmethod
from dataclasses import dataclass, field

import numpy as np
import torch
from jaxtyping import Float64
from scipy.sparse import csr_matrix
from torch import Tensor

from sdfnet.errors import ConfigurationError
from sdfnet.physics.motion import EquationOfMotion

LENGTHS_KEPT = 64  # of time whose propagators are kept: a regular table of a load has a few, of an irregular one each comes once


@dataclass(eq=False)
class State:
    """Where the free degrees of freedom are (m) and how fast (m/s); a column is a load case. Stepping changes it in place."""

    displacement: Float64[Tensor, "dofs columns"]
    velocity: Float64[Tensor, "dofs columns"]  # at the displacement's time, or half a step before it (`Integrator.velocity_lag`)
    step: int = 0
    work: dict[str, Float64[Tensor, " columns"]] = field(
        default_factory=dict
    )  # J, done so far by timed loads ("loads") and by force laws ("laws"), and put into these by "drives"
    own: dict[str, Tensor] = field(default_factory=dict)  # what the method carries from step to step besides


class Integrator(ABC):
    """Steps an equation of motion through time with a fixed step (s)."""

    is_explicit: bool  # whether the step must stay under the stability limit
    is_exact_in_time: bool = False  # whether it follows loads that are piecewise straight lines to rounding, at any step
    velocity_lag: float = 0.0  # how many steps the state's velocity is behind its displacement
    refuses: tuple[str, ...] = ()  # what it cannot do, in the words of `check`

    def __init__(self, motion: EquationOfMotion, time_step: float) -> None:
        self.motion, self.time_step = motion, time_step

    @abstractmethod
    def initial_state(self) -> State:
        """The state at time 0."""

    @abstractmethod
    def advance(self, state: State, steps: int) -> None:
        """Take so many steps, in place."""

    @abstractmethod
    def energy(self, state: State) -> Float64[np.ndarray, " columns"]:
        """What the method keeps, J: exactly (to rounding) under constant loads, and changed by `state.work` otherwise."""

    @classmethod
    def check(cls, name: str, motion: EquationOfMotion, is_lumped: bool, device: str = "cpu") -> None:
        """Raise ConfigurationError when the method cannot integrate this equation on this device."""
        present = {
            "damping": bool(motion.damping),
            "loads that change with time": bool(motion.timed_loads),
            "forces that follow the state": bool(motion.laws),
            "a consistent mass": not is_lumped,
        }
        for what in (what for what in cls.refuses if present[what]):
            raise ConfigurationError(f"solver.integrator={name} cannot integrate {what}, which this scene has; set solver.integrator=leapfrog")
        if device != "cpu" and not (cls.is_explicit and is_lumped and not motion.laws):
            raise ConfigurationError(f"a run on {device} needs an explicit integrator, a lumped mass and no forces that follow the state; run it on the CPU")


def torch_csr(matrix: csr_matrix, device: str = "cpu") -> Tensor:
    """The same matrix for torch, with 32-bit indices: with 64-bit ones MKL converts them at every product (1.6 times slower)."""
    matrix.sort_indices()
    rows, columns = (torch.from_numpy(indices.astype(np.int32)) for indices in (matrix.indptr, matrix.indices))
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Sparse CSR tensor support is in beta", category=UserWarning)
        result = torch.sparse_csr_tensor(rows, columns, torch.from_numpy(matrix.data), size=matrix.shape, dtype=torch.float64, check_invariants=True)
        return result.to(device)
