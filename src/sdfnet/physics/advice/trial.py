"""Cheap runs of a scene and of its variants in reduced coordinates: what an effect would change, before anyone pays for it."""

import math
from dataclasses import replace
from functools import cached_property

import numpy as np
from jaxtyping import Float64, Int64
from scipy.sparse import csr_matrix

from sdfnet.errors import PhysicsError
from sdfnet.physics.advice.quadratic_tets import QuadraticTets
from sdfnet.physics.advice.reduced_laws import contact, counterpart_element, finite_strain_excess, linear_tets
from sdfnet.physics.advice.reduced_model import Acting, ReducedLaw, ReducedModel, reduced_model, strongest
from sdfnet.physics.effects.gravity import Gravity
from sdfnet.physics.effects.history import CONSTANT, History
from sdfnet.physics.effects.roles import Damping, ReplacesElasticity
from sdfnet.physics.modes import ShiftedStiffness
from sdfnet.physics.motion import TimedLoad
from sdfnet.physics.plan import Plan

STEP_ANGLE = 0.25  # omega h of the fastest mode kept: its period errs by (omega h)^2 / 24, 0.3 %
TOUCH_ANGLE = 0.5  # omega h of the fastest contact
STEPS_PER_SEGMENT = 4  # of a load's history
MOST_STEPS = 20_000  # of a linear trial, about a second; a longer run is followed in longer steps
MOST_LAW_STEPS = 4_000  # of a trial with a force law: stiffer contacts are followed in longer steps too
MOST_TET_STEPS = 10_000_000  # tets times steps of such a trial, one to two seconds
RUNAWAY = 1e3  # diagonals beyond the motion without the law: farther off, a trial has lost its stability
PROBE = 1e-6  # diagonals by which a contact is pushed in to find its stiffness
STRAINLESS = 1e-9  # of the displacements: no more than this besides rigid motion is rounding
CARRIED = 0.9999  # of the squares of a trial, for which quadratic tets are asked: modes near each other mix what neither has alone
MOST_CARRYING, FEWEST_CARRYING, CARRYING_TETS = 12, 3, 60_000  # coordinates that are asked for: as many as tets times coordinates allow
REFINEMENTS = (1, 2, 4)  # of the steps of a trial that does


class Trial:
    """A scene in reduced coordinates, and its variants: how much each would change the displacements.

    Modes and static answers come from one factorisation; each law gets the answers to its forces along the motion
    without it as coordinates of its own. A change is ||u_variant - u|| / ||u||, squares in the mass norm (at the corners
    of the tets) summed over all frames. Of several load cases the one that stores the most energy stands for all.
    """

    def __init__(self, compiled: Plan) -> None:
        self.compiled, motion, demands = compiled, compiled.equation(), compiled.demands
        self.times = np.linspace(0.0, compiled.scene.recording.duration, compiled.scene.recording.frames)
        self.free, self.mass = motion.free, motion.mass
        self.stiffness = csr_matrix(compiled.model.stiffness[self.free][:, self.free])
        self.factor = ShiftedStiffness(self.stiffness, self.mass)
        slowest = reduced_model(self.stiffness, self.mass, self.factor)
        self.is_held = bool(slowest.squared[0] > self.factor.shift)
        strongest_case = self._strongest_case()
        chosen = {strongest_case: demands.case_loads[strongest_case]} if strongest_case else {}
        loads = {name: self._load(load.nodal_force, load.history) for name, load in (demands.loads | chosen).items()}
        self.weight_names = tuple(name for name, effect in compiled.scene.effects.items() if name in loads and isinstance(effect, Gravity))
        self._weightless = tuple(load for name, load in loads.items() if name not in self.weight_names)
        self._missing_weight = () if self.weight_names else (self._load(Gravity().load(compiled.model).nodal_force, CONSTANT),)
        displacement, velocity = motion.displacement[:, 0], motion.velocity[:, 0]
        self.acting = Acting(tuple(loads.values()), demands.damping, (), displacement, velocity)
        pushes = [load.force for load in (*loads.values(), *self._missing_weight)]
        self.model = self._with_answers(slowest, np.concatenate([*pushes, self.mass.product(velocity[:, None])], axis=1))
        self.law_names = self._add_laws()
        self.path = self._bounded(self.model, self.acting, self.acting.laws)
        self.displacements = self._corners(self.model, self.path)
        self.size = self._norm(self.displacements)

    def weight_change(self) -> float:
        """Of gravity added or, where it acts, taken away."""
        return self._change(replace(self.acting, loads=(*self._weightless, *self._missing_weight)))

    def damping_change(self, damping: Damping) -> float:
        """Of this damping instead of the scene's."""
        return self._change(replace(self.acting, damping=damping))

    def law_change(self, law: ReducedLaw) -> float:
        """Of one more force law."""
        model, prepared = self._prepared(law)
        if model is self.model and not prepared.stiffness.any():
            return 0.0  # no force along the motion without it
        return self._change(replace(self.acting, laws=(*self.acting.laws, prepared)), model)

    def law_removal(self, index: int) -> float:
        """Of one law fewer."""
        return self._change(self.without_law(index))

    def without_law(self, index: int) -> Acting:
        """What acts but for one law."""
        return replace(self.acting, laws=self.acting.laws[:index] + self.acting.laws[index + 1 :])

    def inertia_change(self) -> float:
        """Of the static answer to the loads of each moment instead of the motion; infinite where nothing holds the solid."""
        if not self.is_held:
            return math.inf
        static = self.model.load(self.acting.loads, self.times) / self.model.squared
        return self._relative(self._corners(self.model, static) - self.displacements)

    def element_change(self) -> tuple[float, float]:
        """Of the element's counterpart (`COUNTERPARTS`), and how many times the matrix entries it has."""
        stiffness, answers, entries = counterpart_element(self.compiled)
        model = self.model.with_stiffness(stiffness, answers)
        steps = self._steps_per_frame(self.acting.laws)
        other = model.motion(self.acting, self.times, steps, self.acting.laws)
        return self._relative(self._corners(model, other) - self._corners(self.model, self.path)), entries

    def quadratic_change(self) -> tuple[float, float]:
        """Of quadratic tets in place of linear ones: in their static answer to the elastic forces of the trial, and in the motion.

        Only the coordinates that carry the trial are answered to anew; of the others neither motion has any but rigid ones.
        """
        is_elastic = self.model.squared > self.factor.shift
        most = min(MOST_CARRYING, max(FEWEST_CARRYING, CARRYING_TETS // len(self.compiled.model.mesh.tets)))
        shares = np.square(self.path).sum(axis=0)
        carrying = _carrying(shares * is_elastic, most)
        if shares[carrying].sum() <= STRAINLESS**2 * shares.sum():
            return 0.0, 0.0
        kept = np.concatenate([np.flatnonzero(~is_elastic), carrying])  # rigid motion comes first
        linear, path, count = self.model.part(kept), self.path[:, carrying], len(carrying)
        shapes = linear.shapes[:, -count:]
        answer = QuadraticTets(linear_tets(self.compiled), self.compiled.fixed).answer(self.factor.solve, shapes, self.stiffness @ shapes)
        static = self._relative(self._nodal(path @ (answer.corners - shapes).T))
        rigid, energies = linear.shapes[:, :-count], np.zeros((len(kept), len(kept)))
        energies[-count:, -count:] = answer.stiffness
        vectors, worked = (np.concatenate([rigid, columns], axis=1) for columns in (answer.corners, answer.worked))
        quadratic = linear.spanned(vectors, worked, energies)
        contacts = tuple(law for law in self.acting.laws if law.is_contact)  # so few coordinates do not carry an elastic law
        acting, steps = replace(self.acting, laws=contacts), self._steps_per_frame(contacts)
        here, there = (self._corners(model, model.motion(acting, self.times, steps, contacts)) for model in (linear, quadratic))
        size = self._norm(here)
        return static, self._norm(there - here) / size if self._is_bounded(there, here) and size > 0 else math.inf

    @cached_property
    def governing_frequency(self) -> float:
        """The angular frequency of the mode that carries most of the motion about its mean, 1/s; the slowest elastic one where nothing moves."""
        swing = self.path.var(axis=0) * self.model.squared * (self.model.is_mode & (self.model.squared > self.factor.shift))
        chosen = int(swing.argmax()) if swing.any() else int(np.flatnonzero(self.model.squared > self.factor.shift)[0])
        return math.sqrt(self.model.squared[chosen])

    def corners_without_law(self, index: int) -> Float64[np.ndarray, "frames nodes 3"]:
        """The displacements of the trial without one of its laws, m."""
        path = self.model.motion(self.without_law(index), self.times, self._steps_per_frame(self.acting.laws), self.acting.laws)
        return self._corners(self.model, path)

    def _add_laws(self) -> tuple[str, ...]:
        """Let the scene's laws act, contact before elasticity: it sets the path along which that is tried. Their names in this order."""
        effects, laws = self.compiled.scene.effects, self.compiled.demands.laws
        names = sorted(laws, key=lambda name: isinstance(effects[name], ReplacesElasticity))
        for name in names:
            reduce = finite_strain_excess if isinstance(effects[name], ReplacesElasticity) else contact
            self.model, reduced = self._prepared(reduce(self.compiled, laws[name]))
            self.acting = replace(self.acting, laws=(*self.acting.laws, reduced))
        return tuple(names)

    def _strongest_case(self) -> str:
        """The name of the load case that would store the most energy at rest; empty without load cases."""

        def energy(name: str) -> float:
            load = self.compiled.demands.case_loads[name]
            force = load.nodal_force.reshape(-1, 1)[self.free] * max(map(abs, load.history.values))
            return float((force * self.factor.solve(force)).sum())

        return max(self.compiled.demands.case_loads, key=energy, default="")

    def _load(self, nodal_force: Float64[np.ndarray, "nodes 3"], history: History) -> TimedLoad:
        return TimedLoad(nodal_force.reshape(-1, 1)[self.free], history)

    def _with_answers(self, model: ReducedModel, forces: Float64[np.ndarray, "dofs columns"]) -> ReducedModel:
        return model.with_answers(self.stiffness, self.factor.solve, forces)

    def _prepared(self, law: ReducedLaw) -> tuple[ReducedModel, ReducedLaw]:
        """Coordinates with the answers to a law's forces along the motion without it, and the law with the stiffness of what it touches there."""
        path = self._bounded(self.model, self.acting, self.acting.laws)
        forces = np.stack([law.force(self.model.shapes @ q, time) for q, time in zip(path, self.times, strict=True)], axis=1)
        stiffness = np.zeros(len(self.free))
        for frame in np.flatnonzero(forces.any(axis=0)) if law.is_contact else ():
            force, displacement = forces[:, frame], self.model.shapes @ path[frame]
            deeper = -force * (PROBE * self.compiled.model.mesh.diagonal / np.abs(force).max())  # against its own push
            change = np.abs(law.force(displacement + deeper, float(self.times[frame])) - force)
            stiffness = np.maximum(stiffness, np.divide(change, np.abs(deeper), out=np.zeros_like(change), where=deeper != 0))
        return self._with_answers(self.model, strongest(forces)), replace(law, stiffness=stiffness)

    def _change(self, other: Acting, model: ReducedModel | None = None) -> float:
        """||u_other - u|| / ||u||; infinite when the trial goes out of bounds at the finest steps too."""
        model = self.model if model is None else model
        laws = tuple({id(law): law for law in (*self.acting.laws, *other.laws)}.values())
        for refinement in REFINEMENTS:
            steps = refinement * self._steps_per_frame(laws)
            here, there = (self._corners(model, model.motion(acting, self.times, steps, laws)) for acting in (self.acting, other))
            if self._is_bounded(here, there) and self._is_bounded(there, here):
                return self._relative(there - here)
        return math.inf

    def _bounded(self, model: ReducedModel, acting: Acting, laws: tuple[ReducedLaw, ...]) -> Float64[np.ndarray, "frames coordinates"]:
        """The motion at steps fine enough for it to stay in bounds. Raises PhysicsError where none are."""
        linear = self._corners(model, model.motion(replace(acting, laws=()), self.times, self._steps_per_frame(laws), laws)) if acting.laws else None
        for refinement in REFINEMENTS:
            path = model.motion(acting, self.times, refinement * self._steps_per_frame(laws), laws)
            if linear is None or self._is_bounded(self._corners(model, path), linear):
                return path
        raise PhysicsError("a trial of the scene must stay finite to advise on it, found that it does not; simulate the scene with smaller loads first")

    def _is_bounded(self, displacements: np.ndarray, beside: np.ndarray) -> bool:
        """Whether all is finite and not absurdly far beyond another motion; a NaN is not."""
        return bool(np.abs(displacements).max() <= RUNAWAY * self.compiled.model.mesh.diagonal + np.abs(beside).max())

    def _steps_per_frame(self, laws: tuple[ReducedLaw, ...]) -> int:
        """Enough for the fastest mode kept and for every piece of a load's history, as far as the budget allows."""
        interval, pieces = float(self.times[1]), [float(np.diff(load.history.times).min()) for load in self.acting.loads if not load.history.is_constant]
        fastest = math.sqrt(self.model.squared[self.model.is_mode].max()) / STEP_ANGLE
        shapes = self.model.shapes
        touch = max((float(np.linalg.eigvalsh(shapes.T @ (law.stiffness[:, None] * shapes))[-1]) for law in laws if law.stiffness.any()), default=0.0)
        wanted = max(interval * fastest, interval * math.sqrt(touch) / TOUCH_ANGLE, *(STEPS_PER_SEGMENT * interval / piece for piece in pieces))
        n_tets = len(self.compiled.model.mesh.tets) * (8 if self.compiled.model.elements.is_quadratic else 1)
        most = min(MOST_LAW_STEPS, MOST_TET_STEPS / n_tets) if laws else MOST_STEPS
        return max(1, math.ceil(min(wanted, most / (len(self.times) - 1))))

    def _corners(self, model: ReducedModel, path: Float64[np.ndarray, "frames coordinates"]) -> Float64[np.ndarray, "frames nodes 3"]:
        """Displacements at the corners of the tets, m."""
        with np.errstate(over="ignore", invalid="ignore"):
            return self._nodal(path @ model.shapes.T)

    def _nodal(self, displacements: Float64[np.ndarray, "frames dofs"]) -> Float64[np.ndarray, "frames nodes 3"]:
        values = np.zeros((len(displacements), self.compiled.fixed.size))
        values[:, self.free] = displacements
        return values.reshape(len(values), -1, 3)[:, : len(self.compiled.model.mesh.nodes)]

    def _relative(self, difference: Float64[np.ndarray, "frames nodes 3"]) -> float:
        """Its norm over that of the displacements; infinite beside a scene in which nothing moves."""
        size = self._norm(difference)
        return size / self.size if self.size > 0 else math.inf if size > 0 else 0.0

    def _norm(self, displacements: Float64[np.ndarray, "frames nodes 3"]) -> float:
        mesh = self.compiled.model.mesh
        weights = np.bincount(mesh.tets.ravel(), np.repeat(mesh.volumes / 4, 4), minlength=len(mesh.nodes))
        return math.sqrt(float(np.einsum("n,fnc->", weights, displacements**2)))


def _carrying(shares: Float64[np.ndarray, " coordinates"], most: int) -> Int64[np.ndarray, " kept"]:
    """The fewest coordinates with `CARRIED` of all shares, or the largest `most`, ascending."""
    order = np.argsort(-shares)
    enough = 1 + int(np.searchsorted(np.cumsum(shares[order]), CARRIED * shares.sum()))
    return np.sort(order[: min(enough, most)])
