"""From a dataset to its files: the stages that are missing, and nothing else.

Three files, each named by the hash of what it is made from: the tet mesh (geometry settings and the surface file's
bytes), the trajectory (that mesh's own hash and the scene), the distances (the trajectory's name and the sampling).
A lock per file lets two runs at once build it once.
"""

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from filelock import FileLock
from jaxtyping import Float32, Float64, Int64
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from sdfnet.data.sampling import box_points, keep_per_frame, near_surface_points, sampling_box
from sdfnet.data.snapshot import run_resumably
from sdfnet.data.store import (
    DistanceSamples,
    described,
    key_of,
    read_mesh,
    read_mesh_provenance,
    read_provenance,
    read_trajectory,
    remove_unfinished,
    write_distances,
    write_mesh,
    write_trajectory,
)
from sdfnet.errors import ConfigurationError, GeometryError
from sdfnet.geometry.distance import SurfaceDistance
from sdfnet.geometry.solids import ClosedSurface, MeshedGeometry
from sdfnet.geometry.surface import Surface
from sdfnet.geometry.tetmesh import TetMesh
from sdfnet.geometry.winding import sign_disagreements
from sdfnet.physics.frame_checks import frame_checks
from sdfnet.physics.plan import plan
from sdfnet.physics.simulate import require_solid
from sdfnet.physics.trajectory import Trajectory
from sdfnet.scene import Dataset, Sampling, Scene

logger = logging.getLogger(__name__)

Report = Callable[[int, int], None]  # done, total

SIGNS_ASKED = 64  # per frame and kind of point: each asks every face, together they cost a twentieth of the distances
SIGN_TOLERANCE = 0.01  # of the signs asked; overlaps of a surface with itself are thin, a wrong orientation turns half of them


@dataclass(frozen=True)
class PreparedFiles:
    """Where the three stages' files lie, which of them this call built, and the seconds that each took when it was built."""

    mesh: Path
    trajectory: Path
    distances: Path
    built: tuple[str, ...] = ()
    seconds: dict[str, float] = field(default_factory=dict)


def prepare(dataset: Dataset, folder: Path, device: str = "cpu") -> PreparedFiles:
    """Make the files of a dataset that `folder` lacks. Idempotent; safe to run twice at once; a killed run leaves no half file.

    Raises ConfigurationError, GeometryError, PhysicsError or StoreError.
    """
    with _progress_bars() as bars:
        stages = _Stages(bars)
        mesh_path = _mesh_file(dataset, folder, stages)
        mesh = read_mesh(mesh_path)
        scene = dataset.scene
        trajectory_path = folder / f"trajectory-{key_of(mesh.digest, *_simulated(scene))}.h5"
        stages.run("simulation", trajectory_path, lambda report: _make_trajectory(trajectory_path, dataset, mesh, report))
        distances_path = folder / f"distances-{key_of(trajectory_path.stem, dataset.sampling)}.h5"
        stages.run("signed distances", distances_path, lambda report: _make_distances(distances_path, trajectory_path, dataset.sampling, device, report))
    if not stages.built:
        logger.info("nothing to prepare: mesh, trajectory and distances are all in %s", folder)
    made = {"tet mesh": read_mesh_provenance(mesh_path), "simulation": read_provenance(trajectory_path), "signed distances": read_provenance(distances_path)}
    seconds = {what: float(provenance["seconds"]) for what, provenance in made.items()}
    return PreparedFiles(mesh_path, trajectory_path, distances_path, tuple(stages.built), seconds)


def _simulated(scene: Scene) -> tuple[Any, ...]:
    """All of a scene that a trajectory depends on besides its mesh."""
    return scene.effects, scene.load_cases, scene.material, scene.recording, scene.solver


def prepare_mesh(dataset: Dataset, folder: Path) -> TetMesh:
    """The tet mesh of a dataset, made if `folder` lacks it; nothing is simulated."""
    with _progress_bars() as bars:
        return read_mesh(_mesh_file(dataset, folder, _Stages(bars)))


class _Stages:
    """Runs a stage if its file is not there, under a lock, with a progress bar."""

    def __init__(self, bars: Progress) -> None:
        self._bars = bars
        self.built: list[str] = []

    def run(self, what: str, path: Path, make: Callable[[Report], None]) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        with FileLock(path.with_name(f".{path.name}.lock")):
            if path.is_file():
                logger.info("%s: already there, %s", what, path.name)
                return
            remove_unfinished(path)
            task = self._bars.add_task(what, total=None)
            make(lambda done, total: self._bars.update(task, completed=done, total=total))
            self._bars.update(task, completed=1, total=1)
            self.built.append(what)


def _progress_bars() -> Progress:
    return Progress(TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeElapsedColumn(), TextColumn("left"), TimeRemainingColumn())


def _mesh_file(dataset: Dataset, folder: Path, stages: _Stages) -> Path:
    geometry = dataset.scene.geometry
    if not isinstance(geometry, MeshedGeometry):
        raise ConfigurationError(f"scene.geometry must derive from MeshedGeometry, found {type(geometry).__name__}")
    path = folder / f"mesh-{key_of(geometry, geometry.inputs_digest())}.vtu"
    stages.run("tet mesh", path, lambda report: _make_mesh(path, geometry))
    return path


def _make_mesh(path: Path, geometry: MeshedGeometry) -> None:
    began = time.perf_counter()
    if isinstance(geometry, ClosedSurface):
        logger.info("tet mesh: fTetWild takes about half a minute for the bunny and cannot say how far it is")
    mesh = geometry.tet_mesh()
    write_mesh(path, mesh, {"geometry": described(geometry), "seconds": time.perf_counter() - began})


def _make_trajectory(path: Path, dataset: Dataset, mesh: TetMesh, report: Report) -> None:
    began = time.perf_counter()
    trajectory = run_resumably(plan(dataset.scene, mesh), path.with_name(f".{path.stem}.snapshot"), report)
    require_solid(trajectory)
    provenance = {"scene": described(dataset.scene), "mesh": mesh.digest}
    write_trajectory(path, replace(trajectory, checks=frame_checks(trajectory)), provenance | {"seconds": time.perf_counter() - began})


def _make_distances(path: Path, trajectory_path: Path, sampling: Sampling, device: str, report: Report) -> None:
    began = time.perf_counter()
    samples = sample_distances(read_trajectory(trajectory_path), sampling, device, report)
    provenance = {"sampling": described(sampling), "trajectory": trajectory_path.name, "seconds": time.perf_counter() - began}
    write_distances(path, samples, provenance)


def sample_distances(trajectory: Trajectory, sampling: Sampling, device: str = "cpu", report: Report | None = None) -> DistanceSamples:
    """The signed distances of every frame at points shared by all (paper section 3). `report(done, total)` after each frame.

    Raises GeometryError when frames are broken and `sampling.broken_frames` is refuse, and when more signs contradict
    the winding number than `SIGN_TOLERANCE`.
    """
    mesh = trajectory.mesh
    checks = frame_checks(trajectory) if trajectory.checks is None else trajectory.checks
    if checks.broken and sampling.broken_frames == "refuse":
        raise GeometryError(f"every frame must be whole, found that {checks.sentence()}; weaken the load, or accept them with sampling.broken_frames=keep")
    vertices = trajectory.surface_vertices
    box = sampling_box(vertices, sampling.box_scale)
    points = box_points(box, sampling)
    near_points = near_surface_points(vertices, mesh.surface_faces, box, sampling.near_surface_spread * mesh.diagonal, sampling)
    total = 2 * len(vertices)
    distances = deforming_distances(points, vertices, mesh.surface_faces, device, lambda frame: report(frame, total) if report else None)
    near_distances = deforming_distances(
        near_points, vertices, mesh.surface_faces, device, lambda frame: report(len(vertices) + frame, total) if report else None
    )
    for place, asked, found in (("box", points, distances), ("near-surface", near_points, near_distances)):
        _check_signs(trajectory, place, asked, found, sampling.seed)
    return DistanceSamples(box, points, distances, keep_per_frame(distances, sampling), near_points, near_distances)


def _check_signs(
    trajectory: Trajectory, place: str, points: Float32[np.ndarray, "points 3"], distances: Float32[np.ndarray, "frames points"], seed: int
) -> None:
    """Compare a few signs of every frame with winding numbers. Warns of any that disagree, raises GeometryError when they are many."""
    if len(points) == 0:
        return
    asked = np.random.default_rng(seed).integers(len(points), size=SIGNS_ASKED)
    wrong = [sign_disagreements(points[asked], found[asked], trajectory.surface(frame)) for frame, found in enumerate(distances)]
    if not any(wrong):
        return
    total = len(wrong) * SIGNS_ASKED
    message = f"{sum(wrong)} of {total} signs of distances in the {place} points contradict the winding number, most in frame {int(np.argmax(wrong))}"
    if sum(wrong) > SIGN_TOLERANCE * total:
        raise GeometryError(f"{message}; at most {100 * SIGN_TOLERANCE:g} % may: the surface crosses itself there, weaken the load")
    logger.warning("%s", message)


def deforming_distances(
    points: Float32[np.ndarray, "points 3"],
    vertices: Float64[np.ndarray, "frames vertices 3"],
    faces: Int64[np.ndarray, "faces 3"],
    device: str = "cpu",
    after_frame: Callable[[int], None] | None = None,
) -> Float32[np.ndarray, "frames points"]:
    """Signed distance (m) of fixed points to each frame of a deforming surface.

    The hierarchy is refitted per frame, and a frame's search is bounded by the last frame's distance plus the largest
    vertex movement, which no distance can outgrow.
    """
    surface = SurfaceDistance(Surface(vertices[0], faces), device)
    queries = torch.from_numpy(points).to(device)
    distances = np.empty((len(vertices), len(points)), dtype=np.float32)
    found = surface.signed_distance(queries)
    for frame, moved in enumerate(vertices):
        if frame > 0:
            surface.deform(moved)
            found = surface.signed_distance(queries, found.abs() + float(np.linalg.norm(moved - vertices[frame - 1], axis=1).max()))
        distances[frame] = found.cpu().numpy()
        if after_frame is not None:
            after_frame(frame + 1)
    return distances
