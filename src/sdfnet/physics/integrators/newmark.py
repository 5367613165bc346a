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
    (SuperLU). For slow motions of stiff or badly meshed solids, where explicit steps are tiny. Not for waves: what moves
    faster than the step is not damped but delayed. Not with forces that follow the state.
    """

    is_explicit = False
    refuses = ("forces that follow the state",)

    def __init__(self, motion: EquationOfMotion, time_step: float) -> None:
        super().__init__(motion, time_step)
        mass, damping = csc_matrix(motion.mass.matrix()), motion.damping
        self._damping = csc_matrix(damping.mass * mass + damping.stiffness * motion.stiffness)
        operator = csc_matrix(mass + time_step / 2 * self._damping + time_step**2 / 4 * motion.stiffness)
        self._factor = splu(operator, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})

    def initial_state(self) -> State:
        """The initial state as it is given."""
        displacement, velocity = (torch.tensor(values) for values in (self.motion.displacement, self.motion.velocity))
        work = {"loads": torch.zeros(displacement.shape[1], dtype=torch.float64)} if self.motion.timed_loads else {}
        return State(displacement, velocity, 0, work, {"acceleration": torch.from_numpy(self._initial_acceleration())})

    def advance(self, state: State, steps: int) -> None:
        """Take so many steps, in place."""
        h, motion = self.time_step, self.motion
        displacement, velocity, acceleration = state.displacement.numpy(), state.velocity.numpy(), state.own["acceleration"].numpy()
        for _ in range(steps):
            forces = [load.history.factor((state.step + which) * h) * load.force for load in motion.timed_loads for which in (0, 1)]
            predicted = displacement + h * velocity + h**2 / 4 * acceleration
            predicted_velocity = velocity + h / 2 * acceleration
            unbalanced = motion.force_at((state.step + 1) * h) - motion.stiffness @ predicted
            if motion.damping:
                unbalanced -= self._damping @ predicted_velocity
            new = self._factor.solve(unbalanced)
            if state.work:
                moved = h * velocity + h**2 / 4 * (acceleration + new)
                state.work["loads"].add_(torch.from_numpy(sum((force * moved).sum(axis=0) for force in forces) / 2))
            displacement[:] = predicted + h**2 / 4 * new
            velocity[:] = predicted_velocity + h / 2 * new
            acceleration[:] = new
            state.step += 1

    def energy(self, state: State) -> Float64[np.ndarray, " columns"]:
        """1/2 v'Mv + 1/2 u'Ku - f'u, with f the constant load, J."""
        return self.motion.energy(state.displacement.numpy(), state.velocity.numpy())

    def _initial_acceleration(self) -> Float64[np.ndarray, "dofs columns"]:
        motion = self.motion
        unbalanced = motion.force_at(0.0) - motion.stiffness @ motion.displacement
        return motion.mass.solve(unbalanced - self._damping @ motion.velocity)
