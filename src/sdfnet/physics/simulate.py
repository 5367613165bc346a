"""Runs a scene: from a tet mesh at rest to its displacements at the recorded times (paper section 2)."""

import logging
import time
from collections.abc import Callable

import numpy as np
from jaxtyping import Float64

from sdfnet.errors import PhysicsError
from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.elasticity import shape_gradients
from sdfnet.physics.plan import LARGEST_LINEAR_STRAIN, Plan, plan
from sdfnet.physics.trajectory import Trajectory
from sdfnet.scene import Scene

logger = logging.getLogger(__name__)

ENERGY_TOLERANCE = 1e-8  # relative drift of H; rounding gives 1e-12 at most, and beyond the limit it passes this within tens of steps


class SimulationStopped(PhysicsError):
    """A run broke down; `trajectory` keeps the frames up to the last good one."""

    def __init__(self, message: str, trajectory: Trajectory) -> None:
        super().__init__(message)
        self.trajectory = trajectory


def simulate(scene: Scene, mesh: TetMesh, progress: Callable[[int, int], None] | None = None) -> Trajectory:
    """Displacements of a scene on a mesh at its recorded times.

    `progress(done, total)` is called after every frame but the first. Raises PhysicsError when the scene cannot be
    simulated as asked (see `plan`), and SimulationStopped when a frame is not finite or breaks the energy watch.
    """
    return run(plan(scene, mesh), progress)


def run(compiled: Plan, progress: Callable[[int, int], None] | None = None) -> Trajectory:
    """Take the steps of a plan. Raises SimulationStopped."""
    mesh, recording = compiled.model.mesh, compiled.scene.recording
    free = np.flatnonzero(~compiled.fixed.ravel())
    displacements = np.zeros((recording.frames, len(mesh.nodes), 3))
    times = np.linspace(0.0, recording.duration, recording.frames)
    integrator, watch = compiled.compile()
    state = integrator.initial_state()
    drift = watch.drift(state.displacement.numpy(), state.velocity.numpy())
    began = time.perf_counter()
    for frame in range(1, recording.frames):
        integrator.advance(state, compiled.steps_per_frame)
        displacement, velocity = state.displacement.numpy(), state.velocity.numpy()
        with np.errstate(over="ignore", invalid="ignore"):  # what overflows is not finite, and so is caught below
            drift = float(np.maximum(drift, watch.drift(displacement, velocity)))  # unlike max(), keeps a NaN
        if not (np.isfinite(displacement).all() and drift <= ENERGY_TOLERANCE):
            kept = Trajectory(mesh, times[:frame], displacements[:frame], compiled.time_step, compiled.report)
            raise SimulationStopped(_breakdown(compiled, frame, times, drift), kept)
        displacements[frame].reshape(-1)[free] = displacement[:, 0]
        if progress is not None:
            progress(frame, recording.frames - 1)
    seconds = time.perf_counter() - began
    report = compiled.report | _made_how(compiled, seconds, drift) | _deformation(mesh, displacements)
    return Trajectory(mesh, times, displacements, compiled.time_step, report)


def _made_how(compiled: Plan, seconds: float, drift: float) -> dict[str, float | int | str]:
    limits, solver = compiled.limits, compiled.scene.solver
    return {
        "mass": solver.mass,
        "start": solver.start,
        "time_step_s": compiled.time_step,
        "steps": compiled.steps,
        "steps_per_frame": compiled.steps_per_frame,
        "limit_lumped_s": limits.lumped,
        "limit_consistent_s": limits.consistent,
        "limit_courant_paper_s": limits.courant,
        "energy_drift": drift,
        "step_seconds": seconds,
    }


def _deformation(mesh: TetMesh, displacements: Float64[np.ndarray, "frames nodes 3"]) -> dict[str, float | int | str]:
    """How far and how strongly the solid deforms, with warnings where linear elasticity no longer describes it."""
    gradients = shape_gradients(mesh)
    largest, n_inverted, first_inverted = 0.0, 0, -1
    for frame, displacement in enumerate(displacements):
        gradient = np.einsum("tia,tib->tab", displacement[mesh.tets], gradients)
        largest = max(largest, float(np.linalg.norm(gradient, axis=(1, 2)).max()))
        if (np.linalg.det(gradient + np.eye(3)) <= 0).any():
            n_inverted += 1
            first_inverted = frame if first_inverted < 0 else first_inverted
    if largest > LARGEST_LINEAR_STRAIN:
        logger.warning("outside linear elasticity: the displacement gradient reaches %.2g, valid up to about %.2g", largest, LARGEST_LINEAR_STRAIN)
    if n_inverted:
        logger.warning("%d frames hold inverted tets, the first is frame %d: their surfaces may cut themselves", n_inverted, first_inverted)
    return {
        "largest_displacement_m": float(np.linalg.norm(displacements, axis=2).max()),
        "largest_displacement_gradient": largest,
        "frames_with_inverted_tets": n_inverted,
    }


def _breakdown(compiled: Plan, frame: int, times: Float64[np.ndarray, " frames"], drift: float) -> str:
    return (
        f"simulation stopped at step {frame * compiled.steps_per_frame}, t = {times[frame]:.4g} s: the energy watch must hold to {ENERGY_TOLERANCE:g} "
        f"and every value must be finite, found a drift of {drift:.3g}; the last good frame is {frame - 1}, t = {times[frame - 1]:.4g} s. "
        f"The step is {compiled.time_step:.4g} s, {compiled.time_step / compiled.limits.of(compiled.scene.solver.mass):.3f} of the stable limit: "
        "lower solver.time_step or solver.safety"
    )
