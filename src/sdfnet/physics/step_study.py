"""What the time step costs in accuracy, and what the choice of mass does: the first small table of accuracy against time."""

import logging
import math
from dataclasses import dataclass, replace

import numpy as np

from sdfnet.errors import ConfigurationError, PhysicsError
from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.elasticity import ElasticModel, assemble
from sdfnet.physics.mass import mass_of
from sdfnet.physics.plan import Plan, plan
from sdfnet.physics.simulate import run
from sdfnet.physics.trajectory import Trajectory
from sdfnet.scene import Scene

logger = logging.getLogger(__name__)

REFERENCE_REFINEMENT = 10  # a second-order run with a tenth of the step has a hundredth of the error
# How many times shorter than the scene's the studied steps are. The first-order part must first outgrow the second-order
# one; with leapfrog a quarter of the step would already see the reference's own error.
REFINEMENTS = {"symplectic_euler": (1, 2, 4), "leapfrog": (1, 2)}


@dataclass(frozen=True)
class StepStudyRow:
    """One run beside its reference."""

    mass: str
    integrator: str
    time_step: float  # s
    steps: int
    relative_error: float  # ||u - u_ref|| / ||u_ref||, squares in the mass norm summed over all frames
    order: float | None  # fitted to this run and the one with twice the step; None for the longest step
    seconds: float  # for the steps


@dataclass(frozen=True)
class StepStudy:
    """The table, and how far apart the two masses are."""

    rows: tuple[StepStudyRow, ...]
    mass_difference: float  # ||u_lumped - u_consistent|| / ||u_consistent||, both at their largest step: the mesh speaking, not the step
    duration: float  # s, simulated

    def lines(self) -> list[str]:
        """The table for the screen."""
        lines = [f"{'mass':<11}{'integrator':<18}{'step':>13}{'steps':>8}{'error':>12}{'order':>7}{'time':>9}"]
        for row in self.rows:
            order = "" if row.order is None else f"{row.order:.2f}"
            lines.append(
                f"{row.mass:<11}{row.integrator:<18}{row.time_step:>11.3e} s{row.steps:>8}{100 * row.relative_error:>10.4f} %{order:>7}{row.seconds:>7.2f} s"
            )
        lines.append(f"lumped against consistent mass over {self.duration:g} s: {100 * self.mass_difference:.2f} %")
        return lines


def time_step_study(scene: Scene, mesh: TetMesh, duration: float | None = None, masses: tuple[str, ...] = ("lumped", "consistent")) -> StepStudy:
    """Error of the scene's step and of shorter ones, for both explicit integrators, against a tenth of it with the same mass.

    The reference is leapfrog, so that its own error is a hundredth of the best run's. For every mass in
    `masses`; both are compared with each other in any case. `duration` (s) studies only the frames up to then: the
    study takes 20 times as many steps as a run, on the bunny half a minute lumped and three minutes consistent.
    Raises ConfigurationError when no frame falls within `duration`, and PhysicsError as `simulate` does.
    """
    scene = scene if duration is None else _shortened(scene, duration)
    solvers = {mass: replace(scene.solver, mass=mass, integrator="leapfrog") for mass in ("lumped", "consistent", *masses)}
    plans = {mass: plan(replace(scene, solver=solver), mesh) for mass, solver in solvers.items()}
    runs = {mass: run(compiled) for mass, compiled in plans.items()}
    difference = relative_difference(runs["lumped"], runs["consistent"], "consistent", plans["consistent"].model)
    rows = [row for mass in masses for row in _rows(plans[mass], runs[mass])]
    return StepStudy(tuple(rows), difference, scene.recording.duration)


def relative_difference(trajectory: Trajectory, reference: Trajectory, mass: str, model: ElasticModel) -> float:
    """||u - r|| / ||r|| with ||u||^2 = sum over frames of u' M u. Raises PhysicsError when the reference never moves."""
    weighed = assemble(model.mesh, model.material) if model.elements.is_quadratic else model  # frames hold the corners of the tets alone
    weight = mass_of(mass, weighed, np.zeros((len(model.mesh.nodes), 3), dtype=np.bool_))

    def squared_norm(displacements: np.ndarray) -> float:
        columns = displacements.reshape(len(displacements), -1).T
        return float((columns * weight.product(columns)).sum())

    if not reference.displacements.any():
        raise PhysicsError("an error in time needs a motion to compare with, found the rest state in every frame; add a load to the scene")
    return math.sqrt(squared_norm(trajectory.displacements - reference.displacements) / squared_norm(reference.displacements))


def _rows(base: Plan, base_run: Trajectory) -> list[StepStudyRow]:
    """Both integrators at the plan's step and shorter ones, against a tenth of it."""
    mass = base.scene.solver.mass
    reference = run(replace(base, steps_per_frame=REFERENCE_REFINEMENT * base.steps_per_frame))
    rows = []
    for integrator, refinements in REFINEMENTS.items():
        previous: float | None = None
        for refinement in refinements:
            scene = replace(base.scene, solver=replace(base.scene.solver, integrator=integrator))
            refined = replace(base, scene=scene, steps_per_frame=refinement * base.steps_per_frame)
            trajectory = base_run if refined.steps == base.steps and integrator == "leapfrog" else run(refined)
            error = relative_difference(trajectory, reference, mass, base.model)
            order = None if previous is None else math.log2(previous / error)
            logger.info("%s mass, %s, step %.3g s: error %.3g", mass, integrator, refined.time_step, error)
            rows.append(StepStudyRow(mass, integrator, refined.time_step, refined.steps, error, order, float(trajectory.report["step_seconds"])))
            previous = error
    return rows


def _shortened(scene: Scene, duration: float) -> Scene:
    interval = scene.recording.duration / (scene.recording.frames - 1)
    intervals = min(round(duration / interval), scene.recording.frames - 1)
    if intervals < 1:
        raise ConfigurationError(f"a step study needs at least one frame after rest, found a duration of {duration:.4g} s with frames every {interval:.4g} s")
    return replace(scene, recording=replace(scene.recording, duration=intervals * interval, frames=intervals + 1))
