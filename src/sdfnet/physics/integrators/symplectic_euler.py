"""Symplectic Euler: the paper's scheme, velocity first and then position with the new velocity."""

from typing import final

from sdfnet.physics.integrators.explicit import ExplicitIntegrator
from sdfnet.physics.integrators.integrator import State


@final
class SymplecticEuler(ExplicitIntegrator):
    """v <- v + h M^-1 (f - C v - K u), then u <- u + h v (paper section 2, pseudo-code).

    First order: its motion is leapfrog's, started half a step late. Stable for h <= 2 / omega_max, less with damping
    (see `stability`). Not to be preferred to leapfrog, which costs the same; here because it is the paper's.
    A load over time counts with its mean over the step.
    """

    kick_begin = 0.0

    def initial_state(self) -> State:
        """The initial state as it is given, as if its velocity were that of half a step before."""
        return self._given_state()
