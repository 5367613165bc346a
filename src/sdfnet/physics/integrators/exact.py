"""The exact solution in time, to rounding: functions of the stiffness as Chebyshev series. The reference for the others."""

import functools
import math
from typing import final

import numpy as np
import torch
from jaxtyping import Float64
from scipy.fft import dct
from scipy.sparse import csr_matrix, diags, identity

from sdfnet.physics.integrators.integrator import LENGTHS_KEPT, Integrator, State, torch_csr
from sdfnet.physics.modes import largest_eigenvalue
from sdfnet.physics.motion import EquationOfMotion

BOUND_MARGIN = 1.001  # Lanczos comes from below, and Chebyshev polynomials explode outside their interval
LONGEST_STRIDE = 100.0  # omega_max t of one stride: (omega_max t)^3 / 6 times rounding is what it loses at most, 2e-11
ROUNDING = 1e-16  # coefficients under it, relative to the largest, change nothing
SMALL_ANGLE = 0.3  # under it (x - sin x) / x^3 comes from its series: four terms are exact to 1e-15


@final
class Exact(Integrator):
    """u(t) = u0 + t v0 + (1 - cos wt)/w^2 r0 + (wt - sin wt)/w^3 r1, and its derivative, with w^2 = M^-1 K.

    r0 is the acceleration and r1 the jerk at the beginning of a stride. The factors are entire functions of w^2; each
    becomes a Chebyshev series of about (omega_max t)/2 + 20 sparse products (Tal-Ezer and Kosloff 1984): on the bunny
    about as many as leapfrog takes steps, with no error in time but rounding. Strides end where a load over time bends.
    Not for long times: it pays for every wave, as leapfrog does. Not with damping (take modal with all modes, on a small
    mesh), with a consistent mass, or with forces that follow the state.
    """

    is_explicit = False
    is_exact_in_time = True
    refuses = ("damping", "forces that follow the state", "a consistent mass")

    def __init__(self, motion: EquationOfMotion, time_step: float) -> None:
        super().__init__(motion, time_step)
        inverse = 1 / motion.mass.matrix().diagonal()
        root = diags(np.sqrt(inverse))
        self._inverse_mass = torch.from_numpy(inverse[:, None])
        self._bound = BOUND_MARGIN * largest_eigenvalue(csr_matrix(root @ motion.stiffness @ root), None)
        # x of the Chebyshev polynomials: [-1, 1] for w^2 in [0, bound].
        scaled = csr_matrix(diags(inverse) @ motion.stiffness)
        self._product = torch_csr(scaled)
        self._argument = torch_csr(csr_matrix(2 / self._bound * scaled - identity(len(inverse))))
        self._longest = LONGEST_STRIDE / math.sqrt(self._bound)
        self._series = functools.lru_cache(LENGTHS_KEPT)(functools.partial(_chebyshev_series, self._bound))

    def initial_state(self) -> State:
        """The initial state as it is given."""
        return State(torch.tensor(self.motion.displacement), torch.tensor(self.motion.velocity))

    def advance(self, state: State, steps: int) -> None:
        """Take so many steps, in place, in strides as long as rounding and the bends of loads over time let them be."""
        for span, first, last in self.motion.straight_pieces(state.step * self.time_step, steps * self.time_step):
            parts = max(1, math.ceil(span / self._longest))
            for part in range(parts):
                begin, end = (self.motion.force_of(_between(first, last, share / parts)) for share in (part, part + 1))
                self._stride(state, span / parts, begin, end)
        state.step += steps

    def energy(self, state: State) -> Float64[np.ndarray, " columns"]:
        """1/2 v'Mv + 1/2 u'Ku - f'u, with f the constant load, J."""
        return self.motion.energy(state.displacement.numpy(), state.velocity.numpy())

    def _stride(self, state: State, span: float, begin: Float64[np.ndarray, "dofs columns"], end: Float64[np.ndarray, "dofs columns"]) -> None:
        """So many seconds under a force that is a straight line from `begin` to `end`, N."""
        first, last = (self._inverse_mass * torch.from_numpy(force) for force in (begin, end))
        acceleration = first - self._product @ state.displacement
        jerk = (last - first) / span - self._product @ state.velocity
        of_position, of_velocity = self._applied(torch.cat([acceleration, jerk], dim=1), self._series(span))
        state.displacement.add_(state.velocity, alpha=span).add_(of_position)
        state.velocity.add_(of_velocity)

    def _applied(self, block: torch.Tensor, series: np.ndarray) -> tuple[torch.Tensor, torch.Tensor]:
        """(k r0 + q r1, s r0 + k r1) for the block (r0, r1), with the coefficients of the three."""
        columns = block.shape[1] // 2
        position, velocity = torch.zeros_like(block[:, :columns]), torch.zeros_like(block[:, :columns])
        before, now = block, torch.sparse.mm(self._argument, block)
        for order, (k, q, s) in enumerate(series):
            polynomial = before
            before, now = now, torch.addmm(before, self._argument, now, beta=-1, alpha=2) if order + 2 < len(series) else now
            position.add_(polynomial[:, :columns], alpha=k).add_(polynomial[:, columns:], alpha=q)
            velocity.add_(polynomial[:, :columns], alpha=s).add_(polynomial[:, columns:], alpha=k)
        return position, velocity


def _between(first: list[float], last: list[float], share: float) -> list[float]:
    return [(1 - share) * one + share * other for one, other in zip(first, last, strict=True)]


def _chebyshev_series(bound: float, span: float) -> np.ndarray:
    """Coefficients, shape (orders, 3), of (1 - cos wt)/w^2, (wt - sin wt)/w^3 and sin(wt)/w over w^2 in [0, bound]."""
    count = int(math.sqrt(bound) * span) + 100
    angle = np.sqrt(bound * (1 + np.cos(np.pi * (np.arange(count) + 0.5) / count)) / 2) * span
    square = angle**2
    series = 1 / 6 - square / 120 + square**2 / 5040 - square**3 / 362880 + square**4 / 39916800
    cubic = np.where(angle < SMALL_ANGLE, series, (angle - np.sin(angle)) / np.maximum(angle, SMALL_ANGLE) ** 3)
    values = np.stack([0.5 * span**2 * np.sinc(angle / (2 * np.pi)) ** 2, span**3 * cubic, span * np.sinc(angle / np.pi)])
    coefficients = dct(values, axis=1) / count
    coefficients[:, 0] /= 2
    relative = np.abs(coefficients) / np.abs(coefficients).max(axis=1, keepdims=True)
    orders = int(np.flatnonzero((relative > ROUNDING).any(axis=0))[-1]) + 1
    return coefficients[:, : max(orders, 2)].T
