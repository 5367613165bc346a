"""What accuracy in space costs in simulation: elements, masses and meshes beside quadratic tets."""

import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import pyvista
from jaxtyping import Float64
from trimesh.triangles import points_to_barycentric

from sdfnet.cost.simulation_study import clocked, counts_of, first_part, overrides_of, part_note, part_words, rms_mm
from sdfnet.cost.studies import Point, Study, Timing
from sdfnet.errors import SdfnetError
from sdfnet.geometry.solids import Box, ClosedSurface, Sphere
from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.physics.plan import plan
from sdfnet.physics.trajectory import Trajectory
from sdfnet.scene import SOLVER_CHOICES, Geometry, Scene

EDGE_FACTOR = math.sqrt(2)  # between the meshes of a surface: with linear tets the error of a smooth motion halves, the tets are 2.8 times as many


def simulation_space_study(scene: Scene, mesh: TetMesh, mesh_seconds: float, duration: float | None = None, quick: bool = False) -> Study:
    """Elements on the same mesh and linear tets on a coarser and a finer one, against quadratic tets on the same mesh.

    The error is the root mean square of the displacement difference over all frames at the mesh's surface nodes; on another
    mesh the displacement is that of the nearest place of its rest surface. How far the rest surfaces lie apart is not in it.
    All runs keep the scene's integrator, whose error in time `simulation_time_study` gives. Seconds are of meshing, assembly,
    set-up and steps, of a part of the motion estimated for all; `mesh_seconds` is what the given mesh took. `quick` leaves out
    the other meshes and the other mass.

    Quadratic tets take five times the steps of linear ones, each ten times as dear: on the bunny study a `duration` (s) of a
    tenth of the motion. Raises what planning and running the reference raise; what other points raise they keep.
    """
    whole, scene = scene, first_part(scene, duration)
    own, at = scene.solver, mesh.nodes[mesh.surface_nodes]
    solvers = {element: own if element == own.element else replace(own, element=element, time_step="auto") for element in SOLVER_CHOICES["element"]}
    motion = whole.recording.duration
    on_given = partial(_solution, make_mesh=lambda: mesh, motion=motion, mesh_seconds=mesh_seconds)
    variants: list[tuple[Scene, Callable[[], _Solution]]] = []
    variants += [(variant, partial(on_given, variant)) for variant in (replace(scene, solver=solvers[element]) for element in ("P1", "P1_nodal_pressure"))]
    if not quick:
        linear = replace(own, element="P1", time_step="auto")
        other_mass = replace(scene, solver=replace(linear, mass=next(mass for mass in SOLVER_CHOICES["mass"] if mass != own.mass)))
        variants.append((other_mass, partial(on_given, other_mass)))
        for geometry in other_meshes(scene.geometry):
            other = replace(scene, solver=linear, geometry=geometry)
            variants.append((other, partial(_solution, other, geometry.tet_mesh, motion)))
    quadratic = replace(scene, solver=solvers["P2"])
    best = on_given(quadratic)
    reference = displacements_at(at, best.trajectory)
    points = [_point_in_space(scene, variant, solve, at, reference) for variant, solve in variants]
    points.append(replace(_point_in_space(scene, quadratic, lambda: best, at, reference), is_reference=True))
    return Study(
        name="simulation_space",
        title="What mesh and elements cost",
        error_label="RMS displacement error against quadratic tets on the scene's mesh (mm)",
        cost_label=f"mesh, set-up and steps, {part_words(whole, whole)} (s)",
        points=tuple(points),
        part=part_note(scene, whole),
    )


def other_meshes(geometry: Geometry) -> list[ClosedSurface | Sphere | Box]:
    """The same solid meshed coarser and finer; none for a geometry that this module does not know."""
    match geometry:
        case ClosedSurface():
            return [replace(geometry, edge_length=round(geometry.edge_length * factor, 4)) for factor in (EDGE_FACTOR, 1 / EDGE_FACTOR)]
        case Sphere():
            return [replace(geometry, cells=cells) for cells in (max(1, geometry.cells // 2), 2 * geometry.cells)]
        case Box(cells=(x, y, z)):
            return [replace(geometry, cells=cells) for cells in ((max(1, x // 2), max(1, y // 2), max(1, z // 2)), (2 * x, 2 * y, 2 * z))]
        case _:
            return []


def displacements_at(points: Float64[np.ndarray, "points 3"], trajectory: Trajectory) -> Float64[np.ndarray, "frames points 3"]:
    """Displacement (m) of the place of a trajectory's rest surface that is nearest to each point, linear over its triangle."""
    rest = trajectory.mesh.surface()
    faces, nearest = pyvista.PolyData.from_regular_faces(rest.vertices, rest.faces).find_closest_cell(points, return_closest_point=True)
    weights = points_to_barycentric(rest.vertices[rest.faces[faces]], nearest)
    corners = trajectory.mesh.boundary_faces[faces]
    result: np.ndarray = np.einsum("pc,fpcx->fpx", weights, trajectory.displacements[:, corners])
    return result


@dataclass(frozen=True, eq=False)
class _Solution:
    """A run from the mesh on, what all of the motion takes (s), and the run's counts."""

    trajectory: Trajectory
    seconds: float
    counts: dict[str, int]


def _solution(scene: Scene, make_mesh: Callable[[], TetMesh], motion: float, mesh_seconds: float = 0.0) -> _Solution:
    """`motion` is the duration (s) of all of it; `mesh_seconds` is what a mesh took that only has to be handed over."""
    began = time.perf_counter()
    compiled = plan(scene, make_mesh())
    planned = time.perf_counter() - began
    trajectory, _, seconds = clocked(compiled, motion)
    return _Solution(trajectory, mesh_seconds + planned + seconds, counts_of(compiled))


def _point_in_space(
    scene: Scene, variant: Scene, solve: Callable[[], _Solution], at: Float64[np.ndarray, "points 3"], reference: Float64[np.ndarray, "frames points 3"]
) -> Point:
    changed = overrides_of(scene, replace(variant, solver=scene.solver))
    setting = changed[0].removeprefix("dataset.scene.geometry.") if changed else "the scene's mesh"
    named = Point(f"{variant.solver.element}, {variant.solver.mass} mass", setting, is_default=variant == scene, overrides=overrides_of(scene, variant))
    try:
        found = solve()
    except SdfnetError as error:
        return replace(named, failure=str(error))
    error_mm = rms_mm(displacements_at(at, found.trajectory), reference)
    return replace(named, error_mm=error_mm, seconds=Timing.of([found.seconds]), counts=found.counts)
