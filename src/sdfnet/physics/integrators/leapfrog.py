"""Leapfrog (Stoermer-Verlet, central differences): symplectic Euler started with half a kick."""

from typing import final

from sdfnet.physics.integrators.explicit import ExplicitIntegrator
from sdfnet.physics.integrators.integrator import State


@final
class Leapfrog(ExplicitIntegrator):
    """Positions at whole steps, velocities half a step before: second order at the price of the first.

    Stable for h <= 2 / omega_max, less with damping, whose force lags half a step and is first order. Not for stiff
    materials or slow motions: the step follows the smallest element and not the motion; take Newmark or modal there.
    A load over time counts with its mean from half a step before to half a step after.
    """

    kick_begin = -0.5

    def initial_state(self) -> State:
        """The velocity of half a step before time 0: v - h/2 a(0)."""
        state = self._given_state()
        lag = self._velocity_change(state, self._impulses(state, self._mean_factors(0, 1)[0])[0]) - self.time_step * self.motion.damping.mass * state.velocity
        state.velocity.add_(lag, alpha=-0.5)
        return state
