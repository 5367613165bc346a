"""A solid in a few dozen coordinates: its slowest modes, and how it yields to the forces that act. For trials, not for results."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64, Int64
from scipy.linalg import eigh
from scipy.sparse import csr_matrix

from sdfnet.physics.effects.roles import Damping
from sdfnet.physics.mass import Mass
from sdfnet.physics.modes import ShiftedStiffness, modes
from sdfnet.physics.motion import TimedLoad

Answers = Callable[[Float64[np.ndarray, "dofs columns"]], Float64[np.ndarray, "dofs columns"]]

MODES = 20  # with the static answers beside them more change no trial by a hundredth
ANSWERS_PER_LAW = 12  # static answers to the forces of a law along the trial, the strongest first
RADIATION = 0.25  # damping ratio of the answers; between 0.1 and 0.5 trials of pokes are nearest to real runs
DEPENDENT = 1e-8  # a vector whose square is this little of the largest, orthogonal to the others, is rounding
TAKEN_UP = 1e-6  # of a force: when no more than this is left, the coordinates have it already


@dataclass(frozen=True, eq=False)
class ReducedLaw:
    """A force that follows the state, on the free degrees of freedom."""

    force: Callable[[Float64[np.ndarray, " dofs"], float], Float64[np.ndarray, " dofs"]]  # N, at a displacement (m) and a time (s)
    stable_fraction: float  # part of the linear step limit that stays safe while the elastic force stiffens
    is_contact: bool  # whether it only acts on what it touches, and with a stiffness of its own
    stiffness: Float64[np.ndarray, " dofs"]  # N/m, of what it touches; zero until a trial has found that


@dataclass(frozen=True, eq=False)
class Acting:
    """All that acts on the solid in one variant of a scene."""

    loads: tuple[TimedLoad, ...]  # one column each
    damping: Damping
    laws: tuple[ReducedLaw, ...]
    displacement: Float64[np.ndarray, " dofs"]  # m, at time 0
    velocity: Float64[np.ndarray, " dofs"]  # m/s, at time 0


@dataclass(frozen=True, eq=False)
class ReducedModel:
    """u = S q with S'MS = 1 and S'KS = diag(omega^2): modes first, then static answers to forces, orthogonal to them.

    The answers stand for hundreds of fast modes, which carry what they take up away into the solid and bring it back out
    of step: each is damped for that.
    """

    mass: Mass
    shapes: Float64[np.ndarray, "dofs coordinates"]  # kg^-1/2
    squared: Float64[np.ndarray, " coordinates"]  # 1/s^2
    is_mode: Bool[np.ndarray, " coordinates"]
    worked: Float64[np.ndarray, "dofs coordinates"] | None = (
        None  # kg^-1/2, what forces and inertia do work on where these are not the shapes: `QuadraticAnswer.worked`
    )

    def with_answers(self, stiffness: csr_matrix, answers: Answers, forces: Float64[np.ndarray, "dofs columns"]) -> "ReducedModel":
        """The same with the static answers to these forces (N) as coordinates of their own, but for what the coordinates have already."""
        sizes = np.linalg.norm(forces, axis=0)
        if not sizes.any() or len(self.squared) == len(self.shapes):
            return self
        units = forces[:, sizes > 0] / sizes[sizes > 0]
        # What the coordinates take up is left out before the solve: of a free solid it would be its flight, and huge.
        left = units - self.mass.product(self.shapes @ (self.shapes.T @ units))
        left = left[:, np.linalg.norm(left, axis=0) > TAKEN_UP]
        if left.shape[1] == 0:
            return self
        # All answers are made orthogonal together: the new ones are so to the modes, but not to the answers before them.
        modes_only, count = self.shapes[:, self.is_mode], int(self.is_mode.sum())
        found = np.concatenate([self.shapes[:, ~self.is_mode], _apart(self.mass, self.shapes, answers(left))], axis=1)
        vectors, squared = _rayleigh_ritz(self.mass, stiffness, found)
        shapes = np.concatenate([modes_only, _apart(self.mass, modes_only, vectors)], axis=1)
        return ReducedModel(self.mass, shapes, np.concatenate([self.squared[:count], squared]), np.arange(shapes.shape[1]) < count)

    def with_stiffness(self, stiffness: csr_matrix, answers: Answers) -> "ReducedModel":
        """The modes and answers of another stiffness, nearly: one inverse iteration, begun at these."""
        vectors, squared = _rayleigh_ritz(self.mass, stiffness, answers(self.mass.product(self.shapes)))
        return replace(self, shapes=vectors, squared=squared, is_mode=np.arange(len(squared)) < self.is_mode.sum())

    def part(self, kept: Int64[np.ndarray, " kept"]) -> "ReducedModel":
        """Only these coordinates, modes before answers."""
        return ReducedModel(self.mass, self.shapes[:, kept], self.squared[kept], self.is_mode[kept])

    def spanned(
        self, vectors: Float64[np.ndarray, "dofs columns"], worked: Float64[np.ndarray, "dofs columns"], energies: Float64[np.ndarray, "columns columns"]
    ) -> "ReducedModel":
        """Another solid with this mass: the modes in the span of some vectors, whose products in its stiffness are `energies`."""
        squared, turns = eigh(energies, worked.T @ self.mass.product(worked))
        is_mode = np.arange(len(squared)) < self.is_mode.sum()
        return ReducedModel(self.mass, vectors @ turns, np.maximum(squared, 0.0), is_mode, worked @ turns)

    def motion(
        self, acting: Acting, times: Float64[np.ndarray, " frames"], steps_per_frame: int, counted: Sequence[ReducedLaw] | None = None
    ) -> Float64[np.ndarray, "frames coordinates"]:
        """q at the times, by A (v' - v) / h + D (v' + v) / 2 = f - omega^2 q and q' = q + h v', with A = 1 + h^2/4 S'K_max S.

        K_max is the stiffest that elasticity and laws may be, so that no step is too long: what is faster than the steps
        is slowed down (Newmark's average acceleration, the laws explicit). `counted` are the laws of K_max, by default
        those that act; motions to be compared count the same, or their steps would be compared with them.
        """
        h, laws = float(times[1] - times[0]) / steps_per_frame, acting.laws if counted is None else counted
        stiffest = np.diag(self.squared / min((law.stable_fraction for law in laws), default=1.0) ** 2)
        for law in laws:
            stiffest += self.shapes.T @ (law.stiffness[:, None] * self.shapes)
        inertia = np.eye(len(self.squared)) + h**2 / 4 * stiffest
        damping = acting.damping.mass + acting.damping.stiffness * self.squared + np.where(self.is_mode, 0.0, 2 * RADIATION * np.sqrt(self.squared))
        onward = np.linalg.inv(inertia + np.diag(h / 2 * damping))
        ends = np.maximum(h * (np.arange(steps_per_frame * (len(times) - 1) + 1) - 0.5), 0.0)  # as leapfrog counts them: no impulse is lost
        load = self._pushes(acting.loads, [load.history.means(ends) for load in acting.loads], len(ends) - 1)
        amplitude, rate = (self._work(self.mass.product(values[:, None])[:, 0]) for values in (acting.displacement, acting.velocity))
        result = np.zeros((len(times), len(amplitude)))
        result[0] = amplitude
        rate -= h / 2 * np.linalg.solve(inertia, self._pull(acting.laws, load[0], amplitude, 0.0) - damping * rate)
        with np.errstate(over="ignore", invalid="ignore"):  # what overflows is not finite, and so is noticed
            for step, pushed in enumerate(load):
                pull = self._pull(acting.laws, pushed, amplitude, step * h)
                rate = onward @ (inertia @ rate - h / 2 * damping * rate + h * pull)
                amplitude = amplitude + h * rate
                if (step + 1) % steps_per_frame == 0:
                    result[(step + 1) // steps_per_frame] = amplitude
        return result

    def load(self, loads: Sequence[TimedLoad], times: Float64[np.ndarray, " times"]) -> Float64[np.ndarray, "times coordinates"]:
        """S'f at the times."""
        return self._pushes(loads, [np.interp(times, load.history.times, load.history.values) for load in loads], len(times))

    def _pushes(self, loads: Sequence[TimedLoad], factors: Sequence[Float64[np.ndarray, " times"]], count: int) -> Float64[np.ndarray, "times coordinates"]:
        result = np.zeros((count, len(self.squared)))
        for load, strengths in zip(loads, factors, strict=True):
            result += np.outer(strengths, self._work(load.force[:, 0]))
        return result

    def _work(self, force: Float64[np.ndarray, " dofs"]) -> Float64[np.ndarray, " coordinates"]:
        result: np.ndarray = (self.shapes if self.worked is None else self.worked).T @ force
        return result

    def _pull(self, laws: Sequence[ReducedLaw], load: np.ndarray, amplitude: np.ndarray, time: float) -> np.ndarray:
        pull: np.ndarray = load - self.squared * amplitude
        if laws:
            displacement = self.shapes @ amplitude
            pull = pull + self._work(sum((law.force(displacement, time) for law in laws), np.zeros(len(displacement))))
        return pull


def reduced_model(stiffness: csr_matrix, mass: Mass, factor: ShiftedStiffness) -> ReducedModel:
    """The slowest modes alone."""
    kept = modes(stiffness, mass, min(MODES, stiffness.shape[0]), factor)
    return ReducedModel(mass, kept.shapes, kept.angular_frequencies**2, np.ones(len(kept.angular_frequencies), dtype=np.bool_))


def strongest(forces: Float64[np.ndarray, "dofs columns"]) -> Float64[np.ndarray, "dofs kept"]:
    """The directions in which most of the forces of a law lie."""
    values, turns = eigh(forces.T @ forces)
    kept = np.flatnonzero(values > DEPENDENT * values[-1])[-ANSWERS_PER_LAW:]
    result: np.ndarray = forces @ (turns[:, kept] / np.sqrt(values[kept]))
    return result


def _rayleigh_ritz(mass: Mass, stiffness: csr_matrix, vectors: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The best approximate modes in the span of some vectors, and their omega^2."""
    sizes = np.sqrt((vectors * mass.product(vectors)).sum(axis=0))
    units = vectors / np.where(sizes > 0, sizes, 1.0)
    values, turns = eigh(units.T @ mass.product(units))
    kept = values > DEPENDENT * values[-1]
    basis = units @ (turns[:, kept] / np.sqrt(values[kept]))
    squared, turns = eigh(basis.T @ (stiffness @ basis))
    return basis @ turns, np.maximum(squared, 0.0)


def _apart(mass: Mass, shapes: np.ndarray, vectors: np.ndarray) -> np.ndarray:
    """What of the vectors is orthogonal to the shapes; twice, for rounding."""
    for _ in range(2):
        vectors = vectors - shapes @ (shapes.T @ mass.product(vectors))
    return vectors
