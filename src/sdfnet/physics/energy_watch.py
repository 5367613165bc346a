"""The watch that shows when a run is not to be trusted: energy from nowhere."""

import numpy as np
import torch
from jaxtyping import Float64

from sdfnet.physics.effects.roles import ConservingLaw
from sdfnet.physics.integrators.integrator import Integrator, State

ENERGY_TOLERANCE = 1e-8  # relative drift of H; rounding gives 1e-12 at most, and beyond the limit it passes this within tens of steps
LAW_TOLERANCE = 0.1  # of the energy in play that force laws may gain or lose: steps that follow them well stay under 0.02
UNRESOLVED_STEPS = 2  # of a law's work: its force is taken once a step


class EnergyWatch:
    """Watches that a run neither gains nor loses energy but by what acts on it.

    Where only constant loads act, the quantity that the integrator keeps may drift by rounding alone. Loads that change
    with time and force laws do work, which the state accounts for; damping may only take, and no more than there is:
    beyond the step limit it takes without end. Force laws must besides have done the work that their stored energy lost
    and what drives them put in. Methods exact in time keep no account of what loads that change do: with such loads it
    sees only values that are not finite.
    """

    def __init__(self, integrator: Integrator) -> None:
        self._integrator = integrator
        self._laws = integrator.motion.laws
        self._first: Float64[np.ndarray, " columns"] | None = None
        self._stored_first = 0.0
        self._scale = np.zeros(integrator.motion.constant_force.shape[1])
        self.drift = self.law_error = 0.0  # the worst so far

    def memory(self) -> dict[str, Float64[np.ndarray, " values"]]:
        """What later states are compared with, to be handed to `remember` of a watch that goes on."""
        assert self._first is not None
        return {"first": self._first, "scale": self._scale, "others": np.array([self._stored_first, self.drift, self.law_error])}

    def remember(self, memory: dict[str, Float64[np.ndarray, " values"]]) -> None:
        """Go on where another watch stopped."""
        self._first, self._scale = memory["first"], memory["scale"]
        self._stored_first, self.drift, self.law_error = (float(value) for value in memory["others"])

    def problem(self, state: State) -> str | None:
        """What is wrong with a state, None when nothing is. The first call sets what later ones are compared with."""
        if not is_finite(state):
            return "every value must be finite, found some that are not"
        drift, law_error = self._errors(state)
        self.drift, self.law_error = float(np.maximum(self.drift, drift)), float(np.maximum(self.law_error, law_error))  # unlike max(), keeps a NaN
        if not self.drift <= ENERGY_TOLERANCE:
            return f"the energy watch must hold to {ENERGY_TOLERANCE:g}, found a drift of {self.drift:.3g}"
        if not self.law_error <= LAW_TOLERANCE:
            return f"force laws must keep their energy to {LAW_TOLERANCE:g}, found {self.law_error:.3g}"
        return None

    def _errors(self, state: State) -> tuple[float, float]:
        motion = self._integrator.motion
        work = sum((done.cpu().numpy() for kind, done in state.work.items() if kind != "drives"), np.zeros_like(self._scale))
        energy = self._integrator.energy(state) - work
        law_work, stored = (float(state.work["laws"]), self._stored(state)) if self._laws else (0.0, 0.0)
        drives = float(state.work["drives"]) if "drives" in state.work else 0.0
        if self._first is None:
            self._first, self._stored_first = energy, stored
        middle = state.displacement - self._integrator.velocity_lag * self._integrator.time_step * state.velocity
        by_load = np.abs((motion.constant_force * middle.cpu().numpy()).sum(axis=0))
        put_in = by_load + np.abs(work - law_work) + abs(drives)  # what laws do is not: it grows with the error itself
        self._scale = np.maximum(self._scale, put_in)
        is_accounted = "loads" in state.work or not motion.timed_loads
        change = energy - self._first if is_accounted else np.zeros_like(energy)
        change = np.maximum(change, -change - self._in_play) if motion.damping else np.abs(change)
        of_laws = abs(law_work + stored - self._stored_first - drives) - self._unresolved(state)
        return self._relative(np.maximum(change, 0.0)), self._relative(np.atleast_1d(max(of_laws, 0.0))) if self._laws else 0.0

    @property
    def _in_play(self) -> Float64[np.ndarray, " columns"]:
        """The largest work so far plus what there was at first, J."""
        assert self._first is not None
        result: np.ndarray = self._scale + np.abs(self._first) + abs(self._stored_first)
        return result

    def _relative(self, change: Float64[np.ndarray, " columns"]) -> float:
        """The worst column's change over the energy in play."""
        scale = self._in_play
        return float(np.max(np.divide(change, scale, out=np.where(change != 0, np.inf, 0.0), where=scale != 0)))

    def _stored(self, state: State) -> float:
        """The stored energy at the time of the velocity, J, as the work counts it: of laws that look a step ahead the mean of before and after."""
        h, motion, lag = self._integrator.time_step, self._integrator.motion, self._integrator.velocity_lag
        before, middle, after = (motion.nodal(state.displacement - share * h * state.velocity) for share in (2 * lag, lag, 0.0))
        time = (state.step - lag) * h
        return sum(
            (law.stored_energy(before, time) + law.stored_energy(after, time)) / 2 if isinstance(law, ConservingLaw) else law.stored_energy(middle, time)
            for law in self._laws
        )

    def _unresolved(self, state: State) -> float:
        """What drives put in within the steps in which a touch begins, J: over so short a time work and stored energy do not match."""
        driven = [law for law in self._laws if law.is_driven]
        if not driven:
            return 0.0
        h, nodal = self._integrator.time_step, self._integrator.motion.nodal(state.displacement)
        time = state.step * h
        return sum(abs(law.drive_work(law.force(nodal, time), time, time + UNRESOLVED_STEPS * h)) for law in driven)


def is_finite(state: State) -> bool:
    """Whether every displacement and velocity is a number."""
    return bool(torch.isfinite(state.displacement).all() and torch.isfinite(state.velocity).all())
