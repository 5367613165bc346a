"""Compiles a scene on a mesh into the step loop that its effects need, and no more."""

import logging
import math
import time
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float64

from sdfnet.errors import ConfigurationError, PhysicsError
from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.effects.roles import AddsLoad, ConstrainsNodes
from sdfnet.physics.elasticity import ElasticModel, assemble
from sdfnet.physics.integrators.symplectic_euler import SymplecticEuler
from sdfnet.physics.mass import mass_of
from sdfnet.physics.stability import EnergyWatch, StepLimits, step_limits
from sdfnet.scene import Scene, Solver

logger = logging.getLogger(__name__)

LARGEST_LINEAR_STRAIN = 0.1  # linear elasticity drops terms of the strain squared: above this they are ten percent of it
LOCKING_POISSON_RATIO = 0.45  # above it linear tets are visibly too stiff
ROUNDING = 1e-9  # relative: how far interval / step may be from a whole number and still count as one


@dataclass(frozen=True, eq=False)
class Plan:
    """A scene ready to run: its matrices, constraints, load and step. `describe` prints it."""

    scene: Scene
    model: ElasticModel
    fixed: Bool[np.ndarray, "nodes 3"]  # components that do not move
    nodal_force: Float64[np.ndarray, "nodes 3"]  # N, constant
    limits: StepLimits
    steps_per_frame: int
    effect_lines: tuple[str, ...]  # one for each effect: its name, type and what it does here
    report: dict[str, float | int | str]  # what the effects and the plan say for the trajectory's report

    @property
    def time_step(self) -> float:
        """Seconds per step: a whole number of steps fills the interval between two frames."""
        return self.scene.recording.duration / self.steps

    @property
    def steps(self) -> int:
        """Steps in all."""
        return self.steps_per_frame * (self.scene.recording.frames - 1)

    def compile(self) -> tuple[SymplecticEuler, EnergyWatch]:
        """The integrator over the free degrees of freedom (one column, this scene's load) and its energy watch."""
        free = np.flatnonzero(~self.fixed.ravel())
        stiffness = self.model.stiffness[free][:, free]
        mass = mass_of(self.scene.solver.mass, self.model, self.fixed)
        force = self.nodal_force.reshape(-1, 1)[free]
        integrator = SymplecticEuler(stiffness, mass, force, self.time_step, self.scene.solver.start)
        return integrator, EnergyWatch(stiffness, mass, force, self.time_step)

    def predicted_seconds(self) -> float:
        """Wall time of all steps on this machine: twenty real ones, their median times the number of steps."""
        integrator, _ = self.compile()
        state = integrator.initial_state()
        seconds = []
        for _ in range(20):
            start = time.perf_counter()
            integrator.advance(state, 1)
            seconds.append(time.perf_counter() - start)
        return float(np.median(seconds)) * self.steps

    def describe(self) -> str:
        """The plan for the screen: effects, matrices, step limits, step and predicted seconds."""
        n_free, solver = int((~self.fixed).sum()), self.scene.solver
        mass = "lumped (diagonal, no solve)" if solver.mass == "lumped" else "consistent (a sparse solve per step)"
        lines = [
            "effects",
            *(f"  {line}" for line in self.effect_lines),
            "matrices",
            f"  stiffness {self.fixed.size} x {self.fixed.size}, {self.model.stiffness.nnz} entries, {n_free} degrees of freedom free; mass {mass}",
            "step limits",
            *(f"  {line}" for line in self.limits.lines()),
            "step",
            f"  {self.time_step:.4e} s ({self.time_step / self.limits.of(solver.mass):.2f} of the limit), symplectic Euler, start: {solver.start}",
            f"  {self.steps} steps, {self.steps_per_frame} per frame, {self.scene.recording.frames} frames over {self.scene.recording.duration:g} s",
            f"  {self.predicted_seconds():.2g} s predicted for the steps",
        ]
        return "\n".join(lines)


def plan(scene: Scene, mesh: TetMesh) -> Plan:
    """Ask every effect for what its roles promise, and choose the step.

    Raises PhysicsError for a step over the true limit, a load or a constraint on nothing, and a scene in which nothing
    can move. Logs a warning where the scene lies outside linear elasticity, where linear tets lock, and where nothing
    holds or loads the solid.
    """
    model = assemble(mesh, scene.material)
    fixed = np.zeros((len(mesh.nodes), 3), dtype=np.bool_)
    nodal_force = np.zeros((len(mesh.nodes), 3))
    stress = 0.0
    report: dict[str, float | int | str] = {}
    lines = []
    for name, effect in scene.effects.items():
        deeds = []
        if isinstance(effect, ConstrainsNodes):
            held = effect.fixed_components(mesh)
            fixed |= held
            deeds.append(f"fixes {int(held.sum())} components of {int(held.any(axis=1).sum())} nodes")
        if isinstance(effect, AddsLoad):
            load = effect.load(model)
            nodal_force += load.nodal_force
            stress += load.stress
            report.update({f"{name}_{key}": value for key, value in load.report.items()})
            deeds.append(f"adds a constant load ({', '.join(f'{key} {_short(value)}' for key, value in load.report.items())})")
        if not deeds:
            raise ConfigurationError(
                f"effect '{name}' ({type(effect).__name__}) asks nothing of the simulator; derive it from a role in sdfnet.physics.effects.roles"
            )
        lines.append(f"{name}: {type(effect).__name__} {' and '.join(deeds)}")
    _check_that_something_can_move(fixed, nodal_force)
    _warn_about_validity(scene, stress)
    report["load_over_youngs_modulus"] = stress / scene.material.youngs_modulus
    limits = step_limits(model, fixed)
    steps_per_frame = _steps_per_frame(scene, limits)
    return Plan(scene, model, fixed, nodal_force, limits, steps_per_frame, tuple(lines), report)


def _steps_per_frame(scene: Scene, limits: StepLimits) -> int:
    """The fewest steps between two frames with a step no longer than the given one, or than auto allows."""
    solver, interval = scene.solver, scene.recording.duration / (scene.recording.frames - 1)
    longest = _longest_step(solver, limits.of(solver.mass))
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


def _check_that_something_can_move(fixed: Bool[np.ndarray, "nodes 3"], nodal_force: Float64[np.ndarray, "nodes 3"]) -> None:
    if fixed.all():
        raise PhysicsError("the effects must leave something free to move, found every component of every node fixed; pin less")
    if nodal_force.any() and not nodal_force[~fixed].any():
        raise PhysicsError("the load must reach a node that is free to move, found it on fixed components only; move the load or pin less")
    if not nodal_force.any():
        logger.warning("nothing loads the solid: every frame will be the rest state")
    if not fixed.any():
        logger.warning("nothing holds the solid: it flies freely")


def _warn_about_validity(scene: Scene, stress: float) -> None:
    material = scene.material
    if material.poisson_ratio > LOCKING_POISSON_RATIO:
        logger.warning("Poisson ratio %.3g > %.2g: linear tets lock and the solid will look too stiff", material.poisson_ratio, LOCKING_POISSON_RATIO)
    if stress > LARGEST_LINEAR_STRAIN * material.youngs_modulus:
        logger.warning(
            "outside linear elasticity: the load is %.2g of Young's modulus, valid up to about %.2g; it is run as asked (the paper's own scene has 0.8)",
            stress / material.youngs_modulus,
            LARGEST_LINEAR_STRAIN,
        )


def _short(value: float | int | str) -> str:
    return f"{value:.4g}" if isinstance(value, float) else str(value)
