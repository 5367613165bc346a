"""Newmark's method with average acceleration: no stability limit, one factorised solve a step."""

from typing import final

import numpy as np
import torch
from jaxtyping import Float64
from scipy.sparse import csc_matrix
from scipy.sparse.linalg import splu

from sdfnet.physics.integrators.integrator import Integrator, State
from sdfnet.physics.motion import EquationOfMotion


@final
class Newmark(Integrator):
    """u' = u + h v + h^2/4 (a + a'), v' = v + h/2 (a + a'), M a' + C v' + K u' = f(t') (Newmark 1959, beta 1/4, gamma 1/2).

    Second order; keeps the energy of constant loads to rounding. The operator M + h/2 C + h^2/4 K is factorised once
    (SuperLU). A load over time counts with its mean over the step: f(t) and f(t') both are that, and a step begins with
    the acceleration under it. For slow motions of stiff or badly meshed solids, where explicit steps are tiny. Not for
    waves: what moves faster than the step is not damped but delayed. Not with forces that follow the state.
    """

    is_explicit = False
    refuses = ("forces that follow the state",)

    def __init__(self, motion: EquationOfMotion, time_step: float) -> None:
        super().__init__(motion, time_step)
        mass, damping = csc_matrix(motion.mass.matrix()), motion.damping
        self._damping = csc_matrix(damping.mass * mass + damping.stiffness * motion.stiffness)
        operator = csc_matrix(mass + time_step / 2 * self._damping + time_step**2 / 4 * motion.stiffness)
        self._factor = splu(operator, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        self._answers = [motion.mass.solve(load.force) for load in motion.timed_loads]  # the acceleration that each load's full strength is

    def initial_state(self) -> State:
        """The initial state as it is given."""
        displacement, velocity = (torch.tensor(values) for values in (self.motion.displacement, self.motion.velocity))
        work = {"loads": torch.zeros(displacement.shape[1], dtype=torch.float64)} if self.motion.timed_loads else {}
        return State(displacement, velocity, 0, work, {"acceleration": torch.from_numpy(self._initial_acceleration())})

    def advance(self, state: State, steps: int) -> None:
        """Take so many steps, in place."""
        h, motion = self.time_step, self.motion
        displacement, velocity, acceleration = state.displacement.numpy(), state.velocity.numpy(), state.own["acceleration"].numpy()
        factors = self._mean_factors(max(state.step - 1, 0))
        for _ in range(steps):
            before, factors = factors, self._mean_factors(state.step)
            for last, factor, answer in zip(before, factors, self._answers, strict=True):
                acceleration += (factor - last) * answer
            force = motion.force_of(factors)
            predicted = displacement + h * velocity + h**2 / 4 * acceleration
            predicted_velocity = velocity + h / 2 * acceleration
            unbalanced = force - motion.stiffness @ predicted
            if motion.damping:
                unbalanced -= self._damping @ predicted_velocity
            new = self._factor.solve(unbalanced)
            if state.work:
                moved = h * velocity + h**2 / 4 * (acceleration + new)
                state.work["loads"].add_(torch.from_numpy(((force - motion.constant_force) * moved).sum(axis=0)))
            displacement[:] = predicted + h**2 / 4 * new
            velocity[:] = predicted_velocity + h / 2 * new
            acceleration[:] = new
            state.step += 1

    def energy(self, state: State) -> Float64[np.ndarray, " columns"]:
        """1/2 v'Mv + 1/2 u'Ku - f'u, with f the constant load, J."""
        return self.motion.energy(state.displacement.numpy(), state.velocity.numpy())

    def _mean_factors(self, step: int) -> list[float]:
        """Of the loads over time, in the step after so many."""
        return [load.history.mean(step * self.time_step, (step + 1) * self.time_step) for load in self.motion.timed_loads]

    def _initial_acceleration(self) -> Float64[np.ndarray, "dofs columns"]:
        motion = self.motion
        unbalanced = motion.force_of(self._mean_factors(0)) - motion.stiffness @ motion.displacement
        return motion.mass.solve(unbalanced - self._damping @ motion.velocity)
