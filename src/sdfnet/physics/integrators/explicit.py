"""The step that symplectic Euler and leapfrog share, compiled to what the equation of motion holds and no more."""

import numpy as np
import torch
from jaxtyping import Float64
from scipy.sparse import csr_matrix, diags
from torch import Tensor

from sdfnet.errors import ConfigurationError
from sdfnet.physics.effects.roles import ConservingLaw
from sdfnet.physics.integrators.integrator import Integrator, State, torch_csr
from sdfnet.physics.mass import LumpedMass
from sdfnet.physics.motion import EquationOfMotion, NodePlaces


class ExplicitIntegrator(Integrator):
    """v <- v + h M^-1 (f - C v - K u), then u <- u + h v: one sparse product a step, also with Rayleigh damping.

    Derived classes differ in how they start. Many load cases (columns) share each product.
    """

    is_explicit = True
    velocity_lag = 0.5
    kick_begin: float  # in steps from the step's: from there on a kick takes the mean of a load for the length of a step, so that none is lost or counted twice

    def __init__(self, motion: EquationOfMotion, time_step: float, device: str = "cpu") -> None:
        super().__init__(motion, time_step)
        self._device = device
        mass = motion.mass
        # A diagonal mass is divided into the matrix once; any other is solved with at every step.
        inverse_mass = 1 / mass.diagonal if isinstance(mass, LumpedMass) else None
        self._inverse_mass = None if inverse_mass is None else torch.from_numpy(inverse_mass[:, None]).to(device)
        scaled = motion.stiffness if inverse_mass is None else diags(inverse_mass) @ motion.stiffness
        self._matrix = torch_csr(csr_matrix(-time_step * scaled), device) if motion.stiffness.nnz else None
        self._load = self._scaled(torch.from_numpy(time_step * motion.constant_force).to(device))
        self._timed = [torch.from_numpy(time_step * load.force).to(device) for load in motion.timed_loads]
        self._kick = torch.empty_like(self._load)
        self._following = [law for law in motion.laws if not isinstance(law, ConservingLaw)]
        conserving = [(law, motion.places(law.nodes)) for law in motion.laws if isinstance(law, ConservingLaw)]
        mobility = self._scaled(torch.full_like(self._load, time_step**2))  # how far a newton moves a degree of freedom in a step, m
        self._conserving = [(law, places, places.of(mobility)) for law, places in conserving]
        self._is_plain = motion.is_conservative and self._inverse_mass is not None
        self._loaded = self._load.any(dim=1).nonzero()[:, 0]

    @classmethod
    def check(cls, name: str, motion: EquationOfMotion, is_lumped: bool, device: str = "cpu") -> None:
        """Raise ConfigurationError when the method cannot integrate this equation on this device."""
        super().check(name, motion, is_lumped, device)
        if not is_lumped and any(isinstance(law, ConservingLaw) for law in motion.laws):
            raise ConfigurationError("a contact that keeps its energy needs a lumped mass, found solver.mass=consistent; set solver.mass=lumped")

    def advance(self, state: State, steps: int) -> None:
        """Take so many steps, in place."""
        if self._matrix is not None and self._is_plain:
            self._advance_plainly(self._matrix, state, steps)
            return
        shrink = 1 - self.time_step * self.motion.damping.mass
        for factors in self._mean_factors(state.step, steps):
            impulses, driven = self._impulses(state, factors) if state.work else ({}, 0.0)
            kick = self._velocity_change(state, impulses)
            before = state.velocity.clone() if state.work else state.velocity
            if shrink != 1:
                state.velocity.mul_(shrink)
            state.velocity.add_(kick)
            for law, places, mobility in self._conserving:
                self._push(state, before, impulses, law, places, mobility)
            state.displacement.add_(state.velocity, alpha=self.time_step)
            state.step += 1
            for kind, impulse in impulses.items():
                state.work[kind].add_(((before + state.velocity) * impulse).sum(dim=0), alpha=0.5)
            if driven:
                state.work["drives"].add_(driven)

    def _advance_plainly(self, matrix: Tensor, state: State, steps: int) -> None:
        """Constant loads and a diagonal mass alone: three operations a step, in place, of which the first touches loaded components only."""
        kick = self._load[self._loaded]
        for _ in range(steps):
            state.velocity.index_add_(0, self._loaded, kick)
            state.velocity.addmm_(matrix, state.displacement)
            state.displacement.add_(state.velocity, alpha=self.time_step)
        state.step += steps

    def energy(self, state: State) -> Float64[np.ndarray, " columns"]:
        """H = 1/2 v'Mv + 1/2 u'Ku - f'u - (h/2) v'(Ku - f), with f the constant load: kept to 1e-14 over 1e4 steps.

        The plain energy swings by h omega; a step over the stability limit makes the terms of H grow until their
        rounding shows, within tens of steps. With damping, whose force lags, it is H - (h/4) v'Cv that never grows.
        """
        displacement, velocity = state.displacement.cpu().numpy(), state.velocity.cpu().numpy()
        unbalanced = self.motion.stiffness @ displacement - self.motion.constant_force
        momentum = self.motion.mass.product(velocity)
        damping = self.motion.damping
        lag = 0.5 * (damping.mass * momentum + damping.stiffness * (self.motion.stiffness @ velocity)) if damping else 0.0
        energy = (0.5 * velocity * (momentum - self.time_step * (unbalanced + lag))).sum(axis=0)
        return energy + 0.5 * (displacement * (unbalanced - self.motion.constant_force)).sum(axis=0)

    def _given_state(self) -> State:
        """The initial displacement and velocity of the equation of motion."""
        displacement, velocity = (torch.tensor(values, device=self._device) for values in (self.motion.displacement, self.motion.velocity))
        laws = self.motion.laws
        kinds = {"loads": bool(self._timed), "laws": bool(laws), "drives": any(law.is_driven for law in laws)}
        zero = torch.zeros(displacement.shape[1], dtype=torch.float64, device=self._device)
        return State(displacement, velocity, 0, {kind: zero.clone() for kind, is_present in kinds.items() if is_present})

    def _velocity_change(self, state: State, impulses: dict[str, Tensor]) -> Tensor:
        """h M^-1 (f - K (u + beta v)) and the impulses' part: all but the mass-proportional damping, m/s."""
        beta = self.motion.damping.stiffness
        strained = torch.add(state.displacement, state.velocity, alpha=beta) if beta else state.displacement
        if self._matrix is None:
            self._kick.copy_(self._load)
        else:
            torch.addmm(self._load, self._matrix, strained, out=self._kick)
        for impulse in impulses.values():
            self._kick.add_(impulse if self._inverse_mass is None else impulse * self._inverse_mass)
        return self._kick if self._inverse_mass is not None else torch.from_numpy(self.motion.mass.solve(self._kick.numpy()))

    def _impulses(self, state: State, factors: Float64[np.ndarray, " loads"]) -> tuple[dict[str, Tensor], float]:
        """h times the forces that change with time or follow the state, N s, apart for each kind of work; and what drives put in meanwhile, J."""
        time, motion, driven = state.step * self.time_step, self.motion, 0.0
        kinds = {"loads": self._timed, "laws": self._following}
        impulses = {kind: torch.zeros_like(self._load) for kind, present in kinds.items() if present}
        for factor, force in zip(factors, self._timed, strict=True):
            impulses["loads"].add_(force, alpha=factor)
        if self._following:
            nodal = motion.nodal(state.displacement)
        for law in self._following:
            followed = law.force(nodal, time)
            driven += law.drive_work(followed, time - self.time_step / 2, time + self.time_step / 2) if law.is_driven else 0.0
            impulses["laws"].add_(motion.on_free(followed), alpha=self.time_step)
        return impulses, driven

    def _mean_factors(self, first: int, steps: int) -> Float64[np.ndarray, "steps loads"]:
        """Of the loads over time, in each of so many kicks from a step on; none comes before time 0."""
        ends = np.maximum(np.arange(first, first + steps + 1) + self.kick_begin, 0.0) * self.time_step
        means = [load.history.means(ends) for load in self.motion.timed_loads]
        return np.array(means).reshape(len(means), steps).T

    def _push(self, state: State, before: Tensor, impulses: dict[str, Tensor], law: ConservingLaw, places: NodePlaces, mobility: Tensor) -> None:
        """Add what a law that looks a step ahead does to the new velocity and to the impulses, N s."""
        h, here = self.time_step, places.of(state.displacement)
        force = law.force_over_step(here - h * places.of(before), here + h * places.of(state.velocity), mobility)
        if force is None:
            return
        impulse = torch.zeros_like(self._load).index_add_(0, places.index, (h * force * places.is_free).view(-1, 1))
        state.velocity.add_(self._scaled(impulse))
        impulses["laws"] = impulses["laws"] + impulse if "laws" in impulses else impulse

    def _scaled(self, impulse: Tensor) -> Tensor:
        return impulse if self._inverse_mass is None else impulse * self._inverse_mass
