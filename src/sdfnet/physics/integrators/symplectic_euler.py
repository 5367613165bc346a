"""Symplectic Euler: the paper's scheme, velocity first and then position with the new velocity."""

import warnings
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64
from scipy.sparse import csr_matrix, diags
from torch import Tensor

from sdfnet.physics.mass import LumpedMass, Mass


@dataclass(eq=False)
class State:
    """Where the free degrees of freedom are (m) and how fast (m/s); a column is a load case. Stepping changes it in place."""

    displacement: Float64[Tensor, "dofs columns"]
    velocity: Float64[Tensor, "dofs columns"]


class SymplecticEuler:
    """v <- v + h M^-1 (f - K u), then u <- u + h v (paper section 2, pseudo-code), for a constant load f.

    Starting with `rest` (v = 0) is the paper's and first order. Starting with `half_kick` (v = -h/2 M^-1 f, so that the
    first kick counts half) makes it leapfrog with velocities at half steps: second order at no cost.
    Stable for h <= 2 / omega_max (see `stability`). Not for stiff materials or slow motions: the step follows the
    smallest element and not the motion.
    """

    def __init__(self, stiffness: csr_matrix, mass: Mass, force: Float64[np.ndarray, "dofs columns"], time_step: float, start: str) -> None:
        self._time_step = time_step
        self._start = start
        self._acceleration = mass.solve(force)  # of the load alone, m/s^2
        # A diagonal mass is divided into the matrix once; any other is solved with at every step.
        self._solve = None if isinstance(mass, LumpedMass) else mass.solve
        matrix = diags(1 / mass.diagonal) @ stiffness if isinstance(mass, LumpedMass) else stiffness
        self._matrix = _torch_csr(csr_matrix(-time_step * matrix))
        self._load = torch.from_numpy(time_step * (self._acceleration if self._solve is None else force))
        self._kick = torch.empty_like(self._load)

    def initial_state(self) -> State:
        """At rest and undeformed, or with the velocity half a kick back."""
        displacement = torch.zeros_like(self._load)
        velocity = torch.zeros_like(self._load) if self._start == "rest" else torch.from_numpy(-self._time_step / 2 * self._acceleration)
        return State(displacement, velocity)

    def advance(self, state: State, steps: int) -> None:
        """Take so many steps, in place."""
        for _ in range(steps):
            torch.addmm(self._load, self._matrix, state.displacement, out=self._kick)
            if self._solve is None:
                state.velocity.add_(self._kick)
            else:
                state.velocity.add_(torch.from_numpy(self._solve(self._kick.numpy())))
            state.displacement.add_(state.velocity, alpha=self._time_step)


def _torch_csr(matrix: csr_matrix) -> Tensor:
    """The same matrix for torch, with 32-bit indices: with 64-bit ones MKL converts them at every product (1.6 times slower)."""
    matrix.sort_indices()
    rows, columns = (torch.from_numpy(indices.astype(np.int32)) for indices in (matrix.indptr, matrix.indices))
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="Sparse CSR tensor support is in beta", category=UserWarning)
        return torch.sparse_csr_tensor(rows, columns, torch.from_numpy(matrix.data), size=matrix.shape, dtype=torch.float64, check_invariants=True)
