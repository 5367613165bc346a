"""Compiles a scene on a mesh into the step loop that its effects need, and no more."""

import hashlib
import logging
import math
import re
import time
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool
from scipy.sparse import csr_matrix

from sdfnet.checked import taken
from sdfnet.errors import PhysicsError
from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.demands import Demands, demands_of
from sdfnet.physics.doubts import NOTHING_MOVES, doubts
from sdfnet.physics.effects.roles import ChangesMaterial, ConstrainsNodes, Report
from sdfnet.physics.elasticity import ElasticModel, assemble
from sdfnet.physics.energy_watch import EnergyWatch
from sdfnet.physics.following_loads import MOST_STEPS, following_loads
from sdfnet.physics.integrators import INTEGRATORS, Integrator
from sdfnet.physics.mass import mass_of
from sdfnet.physics.materials import with_inclusions
from sdfnet.physics.motion import EquationOfMotion, TimedLoad
from sdfnet.physics.stability import StepLimits, step_limits
from sdfnet.scene import Scene, Solver

logger = logging.getLogger(__name__)

ROUNDING = 1e-9  # relative: how far interval / step may be from a whole number and still count as one
IMPLICIT_STEPS_PER_FRAME = 10  # of Newmark with time_step auto: what happens within a frame's interval is not asked for
TRIAL_SECONDS, FEWEST_TRIAL_STEPS = 0.5, 4  # of which the first half is thrown away: other libraries' idle threads still hold the cores then


@dataclass(frozen=True, eq=False)
class Plan:
    """A scene ready to run: its matrices, what its effects demand, and its step. `describe` prints it."""

    scene: Scene
    model: ElasticModel
    demands: Demands
    limits: StepLimits | None  # none where the integrator has no stability limit
    steps_per_frame: int
    shortened_for: str = ""  # the load over time that needs a shorter step than auto would take without it

    @property
    def time_step(self) -> float:
        """Seconds per step: a whole number of steps fills the interval between two frames."""
        return self.scene.recording.duration / self.steps

    @property
    def steps(self) -> int:
        """Steps in all."""
        return self.steps_per_frame * (self.scene.recording.frames - 1)

    @property
    def fixed(self) -> Bool[np.ndarray, "nodes 3"]:
        """Components that do not move."""
        return self.demands.fixed

    @property
    def report(self) -> Report:
        """What the effects say of themselves, for the trajectory's report."""
        return {**self.demands.report, "load_over_youngs_modulus": self.demands.stress / float(np.min(self.model.material.youngs_modulus))}

    def equation(self) -> EquationOfMotion:
        """The equation of motion on the free degrees of freedom, a column for each load case."""
        demands, columns = self.demands, max(1, len(self.demands.case_loads))
        free = np.flatnonzero(~self.fixed.ravel())
        stiffness = self.model.stiffness[free][:, free]
        constant, timed = np.zeros((len(free), columns)), []
        cases = list(demands.case_loads.values())
        for load, column in [(load, slice(None)) for load in demands.loads.values()] + [(load, slice(k, k + 1)) for k, load in enumerate(cases)]:
            force = np.zeros((len(free), columns))
            force[:, column] = load.nodal_force.reshape(-1, 1)[free]
            if load.history.is_constant:
                constant += load.history.values[0] * force
            else:
                timed.append(TimedLoad(force, load.history))
        displacement, velocity = (np.repeat(values.reshape(-1, 1)[free], columns, axis=1) for values in (demands.start.displacement, demands.start.velocity))
        return EquationOfMotion(
            mass=mass_of(self.scene.solver.mass, self.model, self.fixed),
            stiffness=csr_matrix(stiffness.shape) if demands.replaces_elasticity else stiffness,
            constant_force=constant,
            timed_loads=tuple(timed),
            damping=demands.damping,
            laws=tuple(demands.laws.values()),
            displacement=displacement,
            velocity=velocity,
            free=free,
            n_nodes=len(self.fixed),
        )

    def fingerprint(self) -> str:
        """A hash of all that the steps depend on: mesh, scene, step, and the arrays of effects, which a scene's text abridges.

        Where an object or a function stands in memory is taken out of the text: it is another in every process.
        """
        scene, motion, material = self.scene, self.equation(), self.model.material
        settings = repr((scene.effects, scene.load_cases, scene.material, scene.recording, scene.solver, self.steps_per_frame))
        content = hashlib.sha256(f"{self.model.mesh.digest} {re.sub(r' at 0x[0-9a-f]+', '', settings)}".encode())
        of_tets = (np.asarray(number) for number in (material.youngs_modulus, material.poisson_ratio, material.density))
        for values in (motion.constant_force, *(load.force for load in motion.timed_loads), motion.displacement, motion.velocity, motion.free, *of_tets):
            content.update(np.ascontiguousarray(values).tobytes())
        return content.hexdigest()[:12]

    def compile(self, device: str = "cpu") -> tuple[Integrator, EnergyWatch]:
        """The integrator and its energy watch. Raises ConfigurationError when the one cannot do what the scene needs."""
        solver = self.scene.solver
        kind, motion = INTEGRATORS[solver.integrator], self.equation()
        kind.check(solver.integrator, motion, solver.mass == "lumped", device)
        options = {"count": solver.modes} if solver.integrator == "modal" else {"device": device} if kind.is_explicit else {}
        integrator = kind(motion, self.time_step, **options)
        return integrator, EnergyWatch(integrator)

    def predicted_seconds(self) -> float:
        """Wall time of all steps on this machine: a trial's median step, once threads and caches are warm, times their number."""
        integrator, _ = self.compile()
        state = integrator.initial_state()
        seconds: list[float] = []
        began = time.perf_counter()
        while len(seconds) < min(FEWEST_TRIAL_STEPS, self.steps) or (time.perf_counter() - began < TRIAL_SECONDS and len(seconds) < self.steps):
            start = time.perf_counter()
            integrator.advance(state, 1)
            seconds.append(time.perf_counter() - start)
        return float(np.median(seconds[len(seconds) // 2 :])) * self.steps

    def require_bearable(self) -> None:
        """Raise PhysicsError when there are more steps than anybody waits for, with the time that they would take."""
        if self.steps > MOST_STEPS:
            raise PhysicsError(
                f"a run may take {MOST_STEPS:.0e} steps, this one would take {self.steps:.2g} of {self.time_step:.2g} s, about "
                f"{duration(self.predicted_seconds())} of computing; {self._fewer_steps()}"
            )

    def _fewer_steps(self) -> str:
        if self.limits is None or self.scene.solver.time_step != "auto":
            return "raise solver.time_step, set it to auto, or shorten recording.duration"
        return "shorten recording.duration, set solver.integrator=newmark or modal, whose step is free, or mesh without the tet that governs the step"

    def describe(self) -> str:
        """The plan for the screen: effects, matrices, step limits, step and predicted seconds."""
        solver, recording = self.scene.solver, self.scene.recording
        mass = "lumped (diagonal, no solve)" if solver.mass == "lumped" else "consistent (a sparse solve per step)"
        n_free, cases = int((~self.fixed).sum()), self.demands.case_lines
        limit = "" if self.limits is None else f" ({self.time_step / self.limits.of(solver.mass):.2f} of the limit)"
        lines = [
            "effects",
            *(f"  {line}" for line in self.demands.lines),
            *([] if self.demands.moves else [f"  {NOTHING_MOVES}"]),
            *([f"{len(cases)} load cases in one run, a column each", *(f"  {line}" for line in cases)] if cases else []),
            "matrices",
            f"  {solver.element} elements, stiffness {self.fixed.size} x {self.fixed.size}, {self.model.stiffness.nnz} entries, "
            f"{n_free} degrees of freedom free; mass {mass}",
            *([] if self.limits is None else ["step limits", *(f"  {line}" for line in self.limits.lines())]),
            "step",
            f"  {solver.integrator}: {self._kernel()}",
            f"  {self.time_step:.4e} s{limit}" + (f", so short to follow the load '{self.shortened_for}' over time" if self.shortened_for else ""),
            f"  {self.steps} steps, {self.steps_per_frame} per frame, {recording.frames} frames over {recording.duration:g} s",
            f"  {duration(self.predicted_seconds())} predicted for the steps",
            *([f"  a run refuses more than {MOST_STEPS:.0e} steps; {self._fewer_steps()}"] if self.steps > MOST_STEPS else []),
        ]
        return "\n".join(lines)

    def _kernel(self) -> str:
        """What one step computes, in words."""
        demands, kind = self.demands, INTEGRATORS[self.scene.solver.integrator]
        parts = [] if demands.replaces_elasticity else ["a sparse product"]
        if not kind.is_explicit:
            parts = {"newmark": ["a sparse product", "a solve with the factor of M + h/2 C + h^2/4 K"], "modal": [f"{self.scene.solver.modes} modes"]}.get(
                self.scene.solver.integrator, ["a Chebyshev series of sparse products"]
            )
        elif self.scene.solver.mass == "consistent":
            parts.append("a solve with the mass")
        timed = sum(not load.history.is_constant for load in (*demands.loads.values(), *demands.case_loads.values()))
        parts += [f"{timed} loads scaled over time"] if timed else []
        parts += ["two scalings for damping"] if demands.damping else []
        return ", ".join(parts + [f"the force of {name}" for name in demands.laws])


def duration(seconds: float) -> str:
    """Seconds, and beside many of them the hours or days that they are."""
    days = seconds / 86400
    longer = f" ({days:.2g} days)" if days > 2 else f" ({24 * days:.2g} hours)" if days > 1 / 12 else ""
    return f"{seconds:.2g} s{longer}"


def plan(scene: Scene, mesh: TetMesh) -> Plan:
    """Ask every effect for what its roles promise, and choose the step.

    Raises PhysicsError for a step over the true limit, a load or a constraint on nothing, and a scene in which nothing
    can move; ConfigurationError for effects or methods that do not go together. Logs a warning where the scene lies
    outside linear elasticity, where the elements lock, and where nothing holds the solid or a part of it.
    """
    scene, mesh = taken("the scene", scene, Scene), taken("the mesh, which for example Sphere().tet_mesh() makes,", mesh, TetMesh)
    inclusions = {name: (effect.tets(mesh), effect.material) for name, effect in scene.effects.items() if isinstance(effect, ChangesMaterial)}
    held = any(isinstance(effect, ConstrainsNodes) for effect in scene.effects.values())
    weight_mass = "consistent" if held else scene.solver.mass  # see Gravity
    model = assemble(mesh, with_inclusions(mesh, scene.material, inclusions), scene.solver.element, weight_mass)
    demands = demands_of(scene, model)
    for doubt in doubts(scene, model, demands):
        logger.warning("%s", doubt)
    kind = INTEGRATORS[scene.solver.integrator]
    limits = step_limits(model, demands.fixed, demands.added_stiffness, demands.damping, demands.stable_fraction) if kind.is_explicit else None
    count = _steps_per_frame(scene, limits)
    finer, load = (count, "") if kind.is_exact_in_time else following_loads(scene, demands, count)
    return Plan(scene, model, demands, limits, finer, load)


def _steps_per_frame(scene: Scene, limits: StepLimits | None) -> int:
    """The fewest steps between two frames with a step no longer than the given one, or than auto allows."""
    solver, interval = scene.solver, scene.recording.duration / (scene.recording.frames - 1)
    longest = _longest_unlimited_step(scene) if limits is None else _longest_step(solver, limits.of(solver.mass))
    count = max(1, math.ceil(interval / longest * (1 - ROUNDING)))
    if solver.time_step != "auto" and interval / count < longest * (1 - ROUNDING):
        logger.info("time step %.6g s shortened to %.6g s, so that %d of them fill the %.6g s between two frames", longest, interval / count, count, interval)
    return count


def _longest_step(solver: Solver, limit: float) -> float:
    if isinstance(solver.time_step, str):
        return solver.safety * limit
    if solver.time_step > limit:
        raise PhysicsError(
            f"time step {solver.time_step:.4g} s exceeds the stable limit {limit:.4g} s of the {solver.mass} mass; lower solver.time_step or set it to auto"
        )
    return solver.time_step


def _longest_unlimited_step(scene: Scene) -> float:
    """The given step or, for auto, a frame's interval or, where the method errs in time, a part of it."""
    if not isinstance(scene.solver.time_step, str):
        return scene.solver.time_step
    interval = scene.recording.duration / (scene.recording.frames - 1)
    return interval if INTEGRATORS[scene.solver.integrator].is_exact_in_time else interval / IMPLICIT_STEPS_PER_FRAME
