"""Modal superposition: the slow modes exactly in time, the fast ones as if they followed the load at once."""

import functools
from typing import final

import numpy as np
import torch
from jaxtyping import Float64
from scipy.linalg import expm

from sdfnet.physics.integrators.integrator import LENGTHS_KEPT, Integrator, State
from sdfnet.physics.modes import ShiftedStiffness, modes
from sdfnet.physics.motion import EquationOfMotion


@final
class Modal(Integrator):
    """u = sum of s_k q_k + (K^-1 - sum of s_k s_k' / omega_k^2) f, q'' + 2 xi omega q' + omega^2 q = s'f (mode acceleration).

    Exact in time for the modes kept, with Rayleigh damping and with loads over time, at whose bends strides end; with all
    modes it is the exact solution. The last term is the static correction: without it a load on a small patch would
    need hundreds of modes. Of an initial state only the part in the modes is kept. For long times, many load cases and
    slow motions. Not for waves and impacts, whose many fast modes are what one wants to see.
    """

    is_explicit = False
    is_exact_in_time = True
    refuses = ("forces that follow the state",)

    def __init__(self, motion: EquationOfMotion, time_step: float, count: int) -> None:
        super().__init__(motion, time_step)
        factor = ShiftedStiffness(motion.stiffness, motion.mass)
        kept = modes(motion.stiffness, motion.mass, min(count, len(motion.free)), factor)
        self._squared, self._shapes = kept.angular_frequencies**2, kept.shapes
        weights = 1 / (self._squared + factor.shift)
        forces = [motion.constant_force, *(load.force for load in motion.timed_loads)]
        self._modal_forces = [self._shapes.T @ force for force in forces]
        everything = len(self._squared) == len(motion.free)
        self._corrections = [
            np.zeros_like(force) if everything else self._without_modes(factor.solve(force) - self._shapes @ (weights[:, None] * modal))
            for force, modal in zip(forces, self._modal_forces, strict=True)
        ]
        self._propagator = functools.lru_cache(LENGTHS_KEPT)(self._exponential)

    def initial_state(self) -> State:
        """The initial state as it is given."""
        displacement, velocity = (torch.tensor(values) for values in (self.motion.displacement, self.motion.velocity))
        amplitude, rate = (torch.from_numpy(self._shapes.T @ self.motion.mass.product(values.numpy())) for values in (displacement, velocity))
        return State(displacement, velocity, 0, {}, {"amplitude": amplitude, "rate": rate})

    def advance(self, state: State, steps: int) -> None:
        """Take so many steps, in place; in one stride where no load bends."""
        for span, first, last in self.motion.straight_pieces(state.step * self.time_step, steps * self.time_step):
            self._stride(state, span, [1.0, *first], [1.0, *last])
        state.step += steps
        amplitude, rate = (state.own[name].numpy() for name in ("amplitude", "rate"))
        factors = [1.0, *(load.history.factor(state.step * self.time_step) for load in self.motion.timed_loads)]
        state.displacement.numpy()[:] = self._shapes @ amplitude + sum(factor * part for factor, part in zip(factors, self._corrections, strict=True))
        state.velocity.numpy()[:] = self._shapes @ rate

    def energy(self, state: State) -> Float64[np.ndarray, " columns"]:
        """Sum over the modes of 1/2 q'^2 + 1/2 omega^2 q^2 - s'f q, with f the constant load, J."""
        amplitude, rate = (state.own[name].numpy() for name in ("amplitude", "rate"))
        stored = 0.5 * rate**2 + amplitude * (0.5 * self._squared[:, None] * amplitude - self._modal_forces[0])
        return stored.sum(axis=0)

    def _stride(self, state: State, span: float, begin: list[float], end: list[float]) -> None:
        """q and q' after so many seconds, while the factors on the forces go along straight lines."""
        amplitude, rate = (state.own[name].numpy() for name in ("amplitude", "rate"))
        first, last = (sum(factor * force for factor, force in zip(factors, self._modal_forces, strict=True)) for factors in (begin, end))
        before = np.stack([amplitude, rate, first, (last - first) / span], axis=1)  # (modes, 4, columns)
        after = self._propagator(span) @ before
        amplitude[:], rate[:] = after[:, 0], after[:, 1]

    def _exponential(self, span: float) -> Float64[np.ndarray, "modes 4 4"]:
        """What takes q, q', s'f and its slope on by so many seconds: one 4 x 4 exponential a mode."""
        damping = self.motion.damping
        generator = np.zeros((len(self._squared), 4, 4))
        generator[:, 0, 1], generator[:, 1, 0], generator[:, 1, 2], generator[:, 2, 3] = 1, -self._squared, 1, 1
        generator[:, 1, 1] = -(damping.mass + damping.stiffness * self._squared)
        return expm(span * generator)

    def _without_modes(self, displacement: Float64[np.ndarray, "dofs columns"]) -> Float64[np.ndarray, "dofs columns"]:
        """What is left of it outside the modes kept: of a free solid the nearly singular solve leaves a large rigid motion by rounding."""
        result: np.ndarray = displacement - self._shapes @ (self._shapes.T @ self.motion.mass.product(displacement))
        return result
