"""What accuracy in time costs in simulation: integrators, masses and steps beside the exact-in-time solution."""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, fields, replace

import numpy as np
from jaxtyping import Float64

from sdfnet.cost.studies import Point, Study, Timing
from sdfnet.errors import ConfigurationError, PhysicsError, SdfnetError
from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.integrators import INTEGRATORS
from sdfnet.physics.plan import Plan, plan
from sdfnet.physics.simulate import run
from sdfnet.physics.trajectory import Trajectory
from sdfnet.scene import SOLVER_CHOICES, Scene, Solver

# How many times shorter than the auto step explicit steps are; a second-order error falls by 4 each time. Consistent masses are solved at each step.
REFINEMENTS = {"lumped": (1, 2, 4), "consistent": (1, 2)}
COARSENINGS = {"lumped": (1, 4, 16), "consistent": (4, 16)}  # how many times longer than it Newmark's are, which nothing limits
EXPLICIT = ("leapfrog", "symplectic_euler")
EXPLICIT_WORDS = tuple(name.replace("_", " ") for name in EXPLICIT)  # as points name them
Displacements = Float64[np.ndarray, "frames nodes 3"]
MODES = (10, 30, 100, 300)
EXTRAPOLATED = (4, 8)  # refinements of the leapfrog runs that are the reference where the exact integrator cannot go
CHEAP, REPEATS = 5.0, 3  # s: what takes less is run so often, in turns


def simulation_time_study(scene: Scene, mesh: TetMesh, duration: float | None = None, quick: bool = False) -> Study:
    """Integrators with both masses at a few steps, against the exact-in-time solution with the same mass on the same mesh.

    The error is the root mean square of the displacement difference over all frames and surface nodes; the reference is
    `exact_in_time`. The exact integrator has a point only in a scene that chose it. Seconds are of the integrator's set-up and
    the steps. `duration` (s) runs only the frames up to then and estimates the seconds of all; `quick` studies only the scene's
    own mass, without the dearest settings of Newmark and modal. A method that cannot do what the scene needs is a failed point.
    Raises ConfigurationError when no frame falls within `duration`, and PhysicsError when the scene cannot be planned or never moves.
    """
    part = first_part(scene, duration)
    masses = (scene.solver.mass,) if quick else SOLVER_CHOICES["mass"]
    solvers = [replace(scene.solver, integrator="leapfrog", mass=mass, time_step="auto") for mass in masses]
    bases = [plan(replace(part, solver=solver), mesh) for solver in solvers]
    if not bases[0].demands.moves:
        raise PhysicsError("an error in time needs a motion to compare with, found a scene that stays at rest; add a load to it")
    found = [_points_in_time(base, scene, quick) for base in bases]
    return Study(
        name="simulation_time",
        title="What the time step costs",
        error_label=f"RMS displacement error against {_reference_words(bases)}, same mass (mm)",
        cost_label=f"set-up and steps, {part_words(scene, scene)} (s)",
        points=tuple(point for points, _ in found for point in points),
        notes=tuple(_notes(found, masses, part_words(part, scene))),
        part=part_note(part, scene),
    )


def part_words(part: Scene, scene: Scene) -> str:
    """What part of a scene's motion it is."""
    before = "" if part == scene else f"the first {1e3 * part.recording.duration:.3g} of "
    return f"{before}{1e3 * scene.recording.duration:.3g} ms of motion"


def part_note(part: Scene, scene: Scene) -> str:
    """What is measured and what is estimated, where only a part of the motion was run; empty for all of it."""
    if part == scene:
        return ""
    return f"Errors and counts are those of {part_words(part, scene)}; seconds are estimated for all of it: set-up once, the steps in proportion."


def first_part(scene: Scene, duration: float | None) -> Scene:
    """The scene up to the last frame within `duration` (s), all of it for None. Raises ConfigurationError when that is the rest state alone."""
    if duration is None:
        return scene
    interval = scene.recording.duration / (scene.recording.frames - 1)
    intervals = min(round(duration / interval), scene.recording.frames - 1)
    if intervals < 1:
        raise ConfigurationError(f"a study needs at least one frame after rest, found a duration of {duration:.4g} s with frames every {interval:.4g} s")
    if intervals == scene.recording.frames - 1:
        return scene  # not a copy whose duration is rounded
    return replace(scene, recording=replace(scene.recording, duration=intervals * interval, frames=intervals + 1))


def exact_in_time(base: Plan) -> Float64[np.ndarray, "frames nodes 3"]:
    """Displacements (m) of a plan of leapfrog without its error in time, as nearly as can be had.

    The exact integrator, to rounding. Where it refuses (consistent mass, damping, forces that follow the state), leapfrog
    with an eighth of the step; if the scene keeps its energy, leapfrog's error has even powers of the step alone, and a run with a
    quarter of the step removes the first of them: u = u_8 + (u_8 - u_4) / 3 (Richardson). If it does not, u_8 is the reference,
    and its own error is missing in what is measured against it: a quarter of that of a run with u_4's step.
    """
    if _has_exact_solution(base):
        exact = replace(base.scene, solver=replace(base.scene.solver, integrator="exact", time_step="auto"))
        return run(plan(exact, base.model.mesh)).displacements
    coarse, fine = EXTRAPOLATED
    best = run(replace(base, steps_per_frame=fine * base.steps_per_frame)).displacements
    return best + (best - run(replace(base, steps_per_frame=coarse * base.steps_per_frame)).displacements) / 3 if base.equation().is_conservative else best


def _has_exact_solution(base: Plan) -> bool:
    """Whether the exact integrator takes a plan of leapfrog."""
    try:
        INTEGRATORS["exact"].check("exact", base.equation(), base.scene.solver.mass == "lumped")
    except ConfigurationError:
        return False
    return True


def rms_mm(displacements: Float64[np.ndarray, "frames points 3"], reference: Float64[np.ndarray, "frames points 3"]) -> float:
    """Root mean square over frames and points of the length of the difference, mm."""
    return float(1e3 * np.sqrt(((displacements - reference) ** 2).sum(axis=2).mean()))


@dataclass(eq=False)
class _Measurement:
    """What is found of one plan over the turns."""

    compiled: Plan
    motion: float  # s, all of it
    seconds: list[float] = field(default_factory=list)
    is_dear: bool = False
    error_mm: float | None = None
    failure: str | None = None

    def take_turn(self, reference: Float64[np.ndarray, "frames nodes 3"]) -> None:
        """Run once more, unless it has failed or is dear."""
        if self.failure is not None or self.is_dear:
            return
        try:
            trajectory, seconds, whole = clocked(self.compiled, self.motion)
        except SdfnetError as error:
            self.failure = str(error)
            return
        surface = trajectory.mesh.surface_nodes
        self.error_mm = rms_mm(trajectory.displacements[:, surface], reference[:, surface])
        self.seconds.append(whole)
        self.is_dear = seconds > CHEAP

    def point(self, scene: Scene) -> Point:
        """It in the diagram of a scene."""
        solver = self.compiled.scene.solver
        return Point(
            method=f"{solver.integrator.replace('_', ' ')}, {solver.mass} mass",
            setting=f"{solver.modes} modes" if solver.integrator == "modal" else f"step {self.compiled.time_step:.3g} s",
            error_mm=self.error_mm,
            seconds=Timing.of(self.seconds) if self.seconds else None,
            counts=counts_of(self.compiled),
            is_default=solver == scene.solver,
            is_reference=solver.integrator == "exact",
            overrides=overrides_of(scene, self.compiled.scene),
            failure=self.failure,
        )


def _reference_words(bases: Sequence[Plan]) -> str:
    """What `exact_in_time` gives for the plans of each mass."""
    is_exact = {base.scene.solver.mass: _has_exact_solution(base) or base.equation().is_conservative for base in bases}
    words = {True: "the exact-in-time solution", False: f"leapfrog with 1/{EXTRAPOLATED[-1]} of the auto step"}
    if len(set(is_exact.values())) == 1:
        return words[next(iter(is_exact.values()))]
    return " or ".join(f"{words[exact]} ({mass})" for mass, exact in is_exact.items())


def _notes(found: Sequence[tuple[list[Point], Displacements | None]], masses: Sequence[str], studied: str) -> Iterator[str]:
    """The explicit integrators' observed orders, their errors in parts of the motion that was studied, and how far the masses lie apart."""
    for points, reference in found:
        for method in dict.fromkeys(point.method for point in points if point.method.startswith(EXPLICIT_WORDS)):
            series = [point for point in points if point.method == method and point.is_measured]
            if reference is None or len(series) < 2:
                continue
            errors, steps = [point.pair[0] for point in series], [point.counts["steps"] for point in series]
            order, motion = -np.polyfit(np.log(steps), np.log(errors), 1)[0], rms_mm(reference, np.zeros_like(reference))
            share = 100 * max(errors) / motion
            yield f"{method}: observed order {order:.2f} over {len(steps)} steps, {share:.2g} % of the RMS displacement at the longest of them."
    references = dict(zip(masses, [reference for _, reference in found], strict=True))
    lumped, consistent = references.get("lumped"), references.get("consistent")
    if lumped is not None and consistent is not None:
        apart = 100 * rms_mm(lumped, consistent) / rms_mm(consistent, np.zeros_like(consistent))
        yield f"Lumped and consistent mass differ by {apart:.2g} % of the RMS displacement over {studied}: that is the mesh speaking, not the step."


def _points_in_time(base: Plan, scene: Scene, quick: bool) -> tuple[list[Point], Displacements | None]:
    """Those of the base's mass, and their reference; where that fails they all fail with it."""
    measurements = [_Measurement(compiled, scene.recording.duration) for compiled in _plans_in_time(base, scene.solver, quick)]
    try:
        reference = exact_in_time(base)
    except SdfnetError as error:
        return [replace(measurement, failure=str(error)).point(scene) for measurement in measurements], None
    for _ in range(REPEATS):
        for measurement in measurements:
            measurement.take_turn(reference)
    return [measurement.point(scene) for measurement in measurements], reference


def _plans_in_time(base: Plan, own: Solver, quick: bool) -> list[Plan]:
    """All that is tried with the base's mass and matrices, and the scene's own solver if it is not among it."""
    mass = base.scene.solver.mass
    plans = [_stepped(base, integrator, refinement * base.steps_per_frame) for integrator in EXPLICIT for refinement in REFINEMENTS[mass]]
    per_frame = dict.fromkeys(max(1, base.steps_per_frame // coarsening) for coarsening in COARSENINGS[mass][quick:])
    plans += [_stepped(base, "newmark", count) for count in per_frame]
    solvers = [replace(base.scene.solver, integrator="modal", modes=count) for count in MODES[: len(MODES) - quick] if count <= (~base.fixed).sum()]
    if own.mass == mass and own not in [compiled.scene.solver for compiled in plans]:
        solvers = list(dict.fromkeys([*solvers, own]))
    return plans + [plan(replace(base.scene, solver=solver), base.model.mesh) for solver in solvers]


def _stepped(base: Plan, integrator: str, steps_per_frame: int) -> Plan:
    """The base by another integrator with other steps; its matrices and loads serve all."""
    interval = base.scene.recording.duration / (base.scene.recording.frames - 1)
    is_auto = integrator in EXPLICIT and steps_per_frame == base.steps_per_frame
    solver = replace(base.scene.solver, integrator=integrator, time_step="auto" if is_auto else interval / steps_per_frame)
    limits = base.limits if integrator in EXPLICIT else None
    return replace(base, scene=replace(base.scene, solver=solver), limits=limits, steps_per_frame=steps_per_frame)


def clocked(compiled: Plan, motion: float) -> tuple[Trajectory, float, float]:
    """A run, the seconds to its last frame, and those to the end of a `motion` (s): the set-up once, the steps in proportion.

    What is checked after the last frame is no part of either.
    """
    laps: list[float] = []
    began = time.perf_counter()
    trajectory = run(compiled, lambda done, total: laps.append(time.perf_counter() - began))
    still_to_step = motion / compiled.scene.recording.duration - 1
    return trajectory, laps[-1], laps[-1] + still_to_step * float(trajectory.report["step_seconds"])


def counts_of(compiled: Plan) -> dict[str, int]:
    """What is done, whatever the machine: unknowns, steps, and of products and solves one a step where the method has them."""
    solver, steps = compiled.scene.solver, compiled.steps
    counts = {"nodes": len(compiled.fixed), "tets": len(compiled.model.mesh.tets), "steps": steps}
    if solver.integrator == "modal":
        return counts | {"modes": solver.modes}
    is_solved = solver.integrator == "newmark" or (solver.integrator in EXPLICIT and solver.mass == "consistent")
    products = {} if solver.integrator == "exact" else {"sparse_products": steps}
    return counts | products | ({"sparse_solves": steps} if is_solved else {})


def overrides_of(scene: Scene, variant: Scene) -> tuple[str, ...]:
    """What a command must be told to run the variant in place of the scene."""
    changed = []
    for group in ("solver", "geometry"):
        before, after = getattr(scene, group), getattr(variant, group)
        for name in (entry.name for entry in fields(after) if getattr(before, entry.name) != getattr(after, entry.name)):
            value = getattr(after, name)
            changed.append(f"dataset.scene.{group}.{name}={list(value) if isinstance(value, tuple) else value}".replace(" ", ""))
    return tuple(changed)
