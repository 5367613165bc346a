"""Runs a scene: from a tet mesh at rest to its displacements at the recorded times (paper section 2)."""

import copy
import logging
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64

from sdfnet.errors import PhysicsError
from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.doubts import LARGEST_LINEAR_STRAIN, NOTHING_MOVES
from sdfnet.physics.effects.roles import Report
from sdfnet.physics.elasticity import displacement_gradients
from sdfnet.physics.energy_watch import EnergyWatch
from sdfnet.physics.integrators.integrator import State
from sdfnet.physics.plan import Plan, plan
from sdfnet.physics.trajectory import Trajectory
from sdfnet.scene import Scene

logger = logging.getLogger(__name__)

LARGEST_DEPARTURE = 2.0  # diagonals, a solid stretched to five times its length; the paper's bunny moves by 0.04 of one

Progress = Callable[[int, int], None]  # frames done, frames in all


class SimulationStopped(PhysicsError):
    """A run broke down; `trajectory` keeps the frames up to the last good one."""

    def __init__(self, message: str, trajectory: Trajectory) -> None:
        super().__init__(message)
        self.trajectory = trajectory


@dataclass(eq=False)
class Snapshot:
    """All that a run needs to go on bit for bit from its last frame."""

    displacements: Float64[np.ndarray, "cases frames nodes 3"]  # m, up to and with the last frame done
    state: State
    watch: dict[str, Float64[np.ndarray, " values"]]  # what the energy watch compares with
    fingerprint: str  # of the plan that it was taken from


def simulate(scene: Scene, mesh: TetMesh, progress: Progress | None = None, device: str = "cpu") -> Trajectory:
    """Displacements of a scene on a mesh at its recorded times.

    `progress(done, total)` is called after every frame but the first. Raises PhysicsError when the scene cannot be
    simulated as asked (see `plan`) or ends as no solid at all, and SimulationStopped when a frame is not finite or breaks the energy watch.
    """
    trajectory = run(plan(scene, mesh), progress, device)
    require_solid(trajectory)
    return trajectory


def run(
    compiled: Plan,
    progress: Progress | None = None,
    device: str = "cpu",
    resume: Snapshot | None = None,
    keep: Callable[[Snapshot], None] | None = None,
) -> Trajectory:
    """Take the steps of a plan. Raises SimulationStopped, and PhysicsError for a snapshot of another plan and for more steps than anybody waits for.

    `keep` is handed a snapshot after every frame, to write or to pass over; `resume` goes on from one, bit for bit.
    """
    fingerprint = "" if resume is None and keep is None else compiled.fingerprint()
    if resume is not None and resume.fingerprint != fingerprint:
        raise PhysicsError(
            f"a run can only go on from a snapshot of its own plan, {fingerprint}, found one of plan {resume.fingerprint or 'unknown'}: "
            "scene, mesh or step differ; begin the run anew, or plan what the snapshot was taken from"
        )
    compiled.require_bearable()
    if not compiled.demands.moves:
        logger.warning("%s", NOTHING_MOVES)
    recording, integrator, watch = compiled.scene.recording, *compiled.compile(device)
    motion = integrator.motion
    times = np.linspace(0.0, recording.duration, recording.frames)
    displacements = np.zeros((motion.constant_force.shape[1], recording.frames, motion.n_nodes, 3))
    if resume is None:
        state, first = integrator.initial_state(), 1
        _record(displacements, 0, state, motion.free)
        watch.problem(state)
    else:
        state, first = copy.deepcopy(resume.state), resume.displacements.shape[1]
        displacements[:, :first] = resume.displacements
        watch.remember(resume.watch)
    began = time.perf_counter()
    for frame in range(first, recording.frames):
        integrator.advance(state, compiled.steps_per_frame)
        with np.errstate(over="ignore", invalid="ignore"):  # what overflows is not finite, and so is caught
            problem = watch.problem(state)
        if problem is not None:
            kept = _trajectory(compiled, times[:frame], displacements[:, :frame], compiled.report)
            raise SimulationStopped(_breakdown(compiled, frame, times, problem), kept)
        _record(displacements, frame, state, motion.free)
        if progress is not None:
            progress(frame, recording.frames - 1)
        if keep is not None:
            keep(Snapshot(displacements[:, : frame + 1], copy.deepcopy(state), watch.memory(), fingerprint))
    seconds = time.perf_counter() - began
    report = compiled.report | _made_how(compiled, seconds, watch) | _laws_report(compiled, displacements[0], times)
    trajectory = _trajectory(compiled, times, displacements, report)
    report.update(_deformation(compiled, trajectory, displacements))
    return trajectory


def require_solid(trajectory: Trajectory) -> None:
    """Raise PhysicsError when a frame is no longer a deformed solid: linear elasticity follows any load, however absurd."""
    diagonal = trajectory.mesh.diagonal
    # Against the mean of the nodes: a thrown solid may fly as far as it likes.
    departures = np.array([np.linalg.norm(frame - frame.mean(axis=0), axis=1).max() for frame in trajectory.displacements]) / diagonal
    if departures.max() > LARGEST_DEPARTURE:
        frame = int(np.argmax(departures > LARGEST_DEPARTURE))
        raise PhysicsError(
            f"nodes may move by {LARGEST_DEPARTURE:g} diagonals of the solid against its mean at most, found {departures.max():.3g}, and too much from "
            f"frame {frame}, t = {trajectory.times[frame]:.4g} s: no solid deforms so. Weaken the loads, which are "
            f"{float(trajectory.report['load_over_youngs_modulus']):.3g} of Young's modulus, or shorten recording.duration"
        )


def _record(displacements: np.ndarray, frame: int, state: State, free: np.ndarray) -> None:
    """Put the state of every column into its case's frame."""
    for case, values in enumerate(state.displacement.cpu().numpy().T):
        displacements[case, frame].reshape(-1)[free] = values


def _trajectory(compiled: Plan, times: np.ndarray, displacements: np.ndarray, report: Report) -> Trajectory:
    """The frames of all cases one after the other, on the corners of the tets."""
    mesh, cases = compiled.model.mesh, tuple(compiled.demands.case_loads)
    corners = displacements[:, :, : len(mesh.nodes)].reshape(-1, len(mesh.nodes), 3)
    return Trajectory(mesh, np.tile(times, len(displacements)), corners, compiled.time_step, report, cases)


def _made_how(compiled: Plan, seconds: float, watch: EnergyWatch) -> Report:
    limits, solver = compiled.limits, compiled.scene.solver
    of_limits: Report = (
        {}
        if limits is None
        else {
            "limit_lumped_s": limits.lumped,
            "limit_consistent_s": limits.consistent,
            "limit_courant_paper_s": limits.courant,
        }
    )
    return {
        "integrator": solver.integrator,
        "mass": solver.mass,
        "element": solver.element,
        "time_step_s": compiled.time_step,
        "steps": compiled.steps,
        "steps_per_frame": compiled.steps_per_frame,
        **of_limits,
        "energy_drift": watch.drift,
        "law_energy_error": watch.law_error,
        "step_seconds": seconds,
    }


def _laws_report(compiled: Plan, displacements: np.ndarray, times: np.ndarray) -> Report:
    return {f"{name}_{key}": value for name, law in compiled.demands.laws.items() for key, value in law.report(displacements, times).items()}


def _deformation(compiled: Plan, trajectory: Trajectory, displacements: Float64[np.ndarray, "cases frames nodes 3"]) -> Report:
    """How far and how strongly the solid deforms, with warnings where linear elasticity no longer describes it."""
    gradients = displacement_gradients(trajectory.mesh, trajectory.displacements)
    largest = max(float(np.linalg.norm(gradient, axis=(1, 2)).max()) for gradient in gradients)
    inverted = np.flatnonzero(trajectory.inverted_tets)
    if largest > LARGEST_LINEAR_STRAIN and not compiled.demands.replaces_elasticity:
        logger.warning("outside linear elasticity: the displacement gradient reaches %.2g, valid up to about %.2g", largest, LARGEST_LINEAR_STRAIN)
    if len(inverted):
        logger.warning("%d frames hold inverted tets, the first is frame %d: their surfaces may cut themselves", len(inverted), inverted[0])
    return {
        "largest_displacement_m": float(np.linalg.norm(displacements, axis=3).max()),
        "largest_displacement_gradient": largest,
        "frames_with_inverted_tets": len(inverted),
    }


def _breakdown(compiled: Plan, frame: int, times: Float64[np.ndarray, " frames"], problem: str) -> str:
    share = "" if compiled.limits is None else f", {compiled.time_step / compiled.limits.of(compiled.scene.solver.mass):.3f} of the stable limit"
    strain = float(compiled.report["load_over_youngs_modulus"])
    weaker = f", or weaken the loads, which are {strain:.2g} of Young's modulus" if strain > LARGEST_LINEAR_STRAIN else ""
    return (
        f"simulation stopped at step {frame * compiled.steps_per_frame}, t = {times[frame]:.4g} s: {problem}; "
        f"the last good frame is {frame - 1}, t = {times[frame - 1]:.4g} s. The step is {compiled.time_step:.4g} s{share}: "
        f"lower solver.time_step or solver.safety{weaker}"
    )
