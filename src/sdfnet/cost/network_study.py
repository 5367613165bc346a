"""The networks of trained runs beside other ways to keep the same shapes: error against bytes, time of a query and time of a frame."""

import logging
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import cycle, pairwise
from pathlib import Path

import torch
from torch import Tensor

from sdfnet.cost.field_baselines import (
    GridField,
    NearestSampleField,
    NetworkField,
    ShapeModel,
    distances_where_it_may_be,
    network_where_it_may_be,
    on_whole_grid,
)
from sdfnet.cost.shape_baselines import DeformedMesh, KeptFrames, PodMotion
from sdfnet.cost.studies import BYTES, LEAST_SECONDS, SECONDS, Point, Study, Timing, interleaved
from sdfnet.cost.sweep_table import Job, Row, Target, overrides_alone, rows_of, shared_overrides, short_setting
from sdfnet.data.store import DistanceSamples, described
from sdfnet.errors import ConfigurationError, SdfnetError
from sdfnet.evaluation.metrics import SurfaceErrors, aggregate, surface_errors
from sdfnet.evaluation.reconstruct import Grid
from sdfnet.geometry.distance import SurfaceDistance
from sdfnet.models.networks import RECORD, Networks, load_networks, read_checkpoint
from sdfnet.models.quantise import quantised
from sdfnet.physics.trajectory import Trajectory

logger = logging.getLogger(__name__)

PARAMETERS = "decoder parameters"
ALL_SAMPLES = 0  # stands for every sample that a frame keeps in a series of KNN-1
BY_MEAN = Target(chamfer_l1_mm=1.0, frames="mean")  # rows take the seed in the middle by a target's frames; whether it is reached is not asked about here


@dataclass(frozen=True)
class Effort:
    """How much is measured. The defaults are the whole of it: minutes on the bunny and two cores."""

    every: int = 3  # frames measured; should share no divisor with the strides: interpolation would be asked only where it is exact, or only where not
    resolution: int = 100  # of the grid that is marched, along each axis
    surface_samples: int = 16_384  # on each of two surfaces that are compared: the mean error is known to about 1 %
    queries: int = 100_000  # asked after a change of frame
    repeats: int = 3
    modes: tuple[int, ...] = (1, 2, 4, 8, 16, 32, 64)
    strides: tuple[int, ...] = (2, 5, 10, 20, 50, 100)
    grid_points: tuple[int, ...] = (3, 4, 6, 8, 12, 16, 24)  # along each axis
    nearest_samples: tuple[int, ...] = (4, 32, 256, 2048, ALL_SAMPLES)


QUICK = Effort(every=11, surface_samples=4096, queries=20_000, repeats=1, modes=(1, 8), strides=(20, 5), grid_points=(8, 16), nearest_samples=(256,))


@dataclass(frozen=True)
class Candidate:
    """A way to keep the shapes that is to be measured."""

    method: str
    setting: str
    make: Callable[[], ShapeModel]  # may raise SdfnetError: the reason why it cannot be measured
    counts: Mapping[str, int] = field(default_factory=dict)  # of a network: its parameters
    is_default: bool = False
    overrides: tuple[str, ...] = ()


@dataclass(frozen=True)
class MeasuredShape:
    """One way to keep the shapes, with chamfer_l1 (mm) over the frames and what it costs, or why it could not be measured."""

    candidate: Candidate
    bytes: int | None = None  # for all frames
    mean_mm: float | None = None
    worst_mm: float | None = None
    query: Timing | None = None  # of one of many queries after a change of frame, which is included
    frame: Timing | None = None  # of the surface of one more frame
    failure: str | None = None

    def point(self, error_mm: float | None, cost: str, seconds: Timing | None = None) -> Point:
        """The point of a diagram, with the mean or the worst error and what its cost is."""
        chosen = self.candidate
        return Point(chosen.method, chosen.setting, error_mm, seconds, chosen.counts, self.bytes, chosen.is_default, chosen.overrides, self.failure, cost=cost)


def network_studies(shapes: Sequence[MeasuredShape]) -> list[Study]:
    """Error against the time of a query, the time of a frame, the bytes that answer for every frame and, of the networks, the parameters of the decoder."""
    mean, worst, kept = "chamfer L1, mean over frames (mm)", "chamfer L1, worst frame (mm)", "to answer for every frame (bytes)"
    by_mean = [shape.point(shape.mean_mm, BYTES) for shape in shapes]
    by_worst = [shape.point(shape.worst_mm, BYTES) for shape in shapes]
    queries = [shape.point(shape.mean_mm, SECONDS, shape.query) for shape in shapes]
    frames = [shape.point(shape.mean_mm, SECONDS, shape.frame) for shape in shapes]
    networks = [shape.point(shape.mean_mm, PARAMETERS) for shape in shapes if PARAMETERS in shape.candidate.counts]
    return [
        Study("network_query", "Answering a query", mean, "one of many queries, change of frame included (s)", tuple(queries)),
        Study("network_frame", "Reconstructing a frame", mean, "the surface of one more frame (s)", tuple(frames)),
        Study("network_bytes_mean", "Keeping the shapes, mean over frames", mean, kept, tuple(by_mean)),
        Study("network_bytes_worst", "Keeping the shapes, worst frame", worst, kept, tuple(by_worst)),
        Study("network_parameters", "The size of a network", mean, PARAMETERS, tuple(networks)),
    ]


def network_candidate(
    name: str, networks: Networks, trajectory: Trajectory, grid: Grid, is_default: bool = False, overrides: tuple[str, ...] = ()
) -> Candidate:
    """A network at hand."""
    return _network_candidate(name, networks.decoder.parameter_count, lambda: networks, trajectory, grid, is_default, overrides)


def sweep_candidates(jobs: Sequence[Job], trajectory: Trajectory, grid: Grid, files: Mapping[str, str], asked: Mapping[str, object]) -> list[Candidate]:
    """A network for each setting of finished jobs: that of the seed in the middle by the errors of the runs, stored as its run stored it.

    The default is the setting that was trained as `asked`, parts of train.py's settings by their names. `files` are those
    of the shapes at hand, as `networks_trained_on` wants them.
    """
    finished, shared = [job for job in jobs if job.result is not None], shared_overrides(jobs)
    return [_sweep_candidate(row, short_setting(row.setting, shared), finished, trajectory, grid, files, asked) for row in rows_of(finished, BY_MEAN)]


def networks_trained_on(files: Mapping[str, str], checkpoint: Path) -> Networks:
    """The networks of a checkpoint. Raises TrainingError, and ConfigurationError when they were trained on other prepared files."""
    record = read_checkpoint(checkpoint)[RECORD]
    found = {name: record.get(name) for name in files}
    if found != files:
        raise ConfigurationError(
            f"'{checkpoint}' must have been trained on the dataset that is studied, {', '.join(files.values())}, found {', '.join(map(str, found.values()))}; "
            "choose the dataset and the sampling that it was trained on, or another checkpoint"
        )
    return load_networks(checkpoint)


def baseline_candidates(trajectory: Trajectory, samples: DistanceSamples, grid: Grid, effort: Effort) -> list[Candidate]:
    """Every other way, at the sizes of `effort`; what has more modes or samples than there are is left out."""
    vertices, faces, box, kept = trajectory.surface_vertices, trajectory.mesh.surface_faces, samples.box, samples.kept.shape[1]
    cases = max(1, len(trajectory.cases))

    def pod(modes: int) -> ShapeModel:
        return DeformedMesh(PodMotion.of(vertices, modes), faces)

    def interpolated(stride: int) -> ShapeModel:
        return DeformedMesh(KeptFrames.of(vertices, stride, cases), faces)

    def stored(points: int) -> ShapeModel:
        return distances_where_it_may_be(GridField.of(trajectory, Grid(box.lower, box.upper, points)), grid)

    def nearest(count: int) -> ShapeModel:
        return on_whole_grid(NearestSampleField(samples, count or kept), grid)

    return [
        *[Candidate("POD, exact query", f"{modes} mode{'s' * (modes > 1)}", partial(pod, modes)) for modes in effort.modes if modes <= len(vertices)],
        *[Candidate("kept frames, exact query", f"every {stride}", partial(interpolated, stride)) for stride in effort.strides],
        *[Candidate("grid of distances", f"{points}^3", partial(stored, points)) for points in effort.grid_points],
        *[Candidate("KNN-1", f"{count or kept:,} samples", partial(nearest, count)) for count in effort.nearest_samples if count <= kept],
    ]


def measured_shapes(candidates: Sequence[Candidate], trajectory: Trajectory, samples: DistanceSamples, effort: Effort) -> list[MeasuredShape]:
    """Errors, bytes and times of every candidate. What cannot be made, or has a frame without a surface, keeps its place with the reason.

    Times are of frames between those whose errors are measured, one after the other. A network has encoded most grid points by then, once for all shapes:
    what those that are new cost is in `reconstruction_study`.
    """
    frames = compared_frames(len(trajectory.times), effort.every, max(1, len(trajectory.cases)))
    timed = timed_frames(frames, len(trajectory.times))
    truth = SurfaceDistance(trajectory.surface(0))
    made: dict[int, ShapeModel] = {}
    found: list[MeasuredShape] = []
    for place, candidate in enumerate(candidates):
        try:
            model = candidate.make()
            errors = _errors(model, trajectory, frames, truth, effort.surface_samples)
        except SdfnetError as error:
            logger.info("%s, %s: %s", candidate.method, candidate.setting, error)
            found.append(MeasuredShape(candidate, failure=str(error)))
            continue
        made[place] = model
        found.append(MeasuredShape(candidate, model.bytes, *errors))
    points = torch.from_numpy(samples.points[:: max(1, len(samples.points) // effort.queries)])
    query = interleaved({str(place): partial(_ask, model, cycle(timed), points) for place, model in made.items()}, effort.repeats, LEAST_SECONDS)
    frame = interleaved({str(place): partial(_reconstruct, model, cycle(timed)) for place, model in made.items()}, effort.repeats, LEAST_SECONDS)
    return [
        replace(shape, query=query[str(place)].divided_by(len(points)), frame=frame[str(place)]) if place in made else shape
        for place, shape in enumerate(found)
    ]


def compared_frames(count: int, every: int, cases: int = 1) -> list[int]:
    """Every `every`-th frame of each load case, counted back from its last, or each where that would be fewer than four; never the first, which is at rest."""
    length = count // cases
    every = every if length > 4 * every else 1
    return [frame for frame in range(count) if frame % length and (length - 1 - frame % length) % every == 0] or [count - 1]


def timed_frames(compared: Sequence[int], count: int) -> list[int]:
    """Frames between those that are compared; where these are fewer than two, and one would follow itself, all of them."""
    between = [(one + following) // 2 for one, following in pairwise(compared)]
    return between if len(between) > 1 else list(range(count))


def _network_candidate(
    name: str, parameters: int, networks: Callable[[], Networks], trajectory: Trajectory, grid: Grid, is_default: bool, overrides: tuple[str, ...]
) -> Candidate:
    """A network that is loaded when it is measured."""

    def make() -> ShapeModel:
        return network_where_it_may_be(NetworkField(networks(), trajectory.surface_vertices), grid)

    return Candidate("network", f"{name}, {parameters:,} parameters", make, {PARAMETERS: parameters}, is_default, overrides)


def _sweep_candidate(
    row: Row, name: str, jobs: Sequence[Job], trajectory: Trajectory, grid: Grid, files: Mapping[str, str], asked: Mapping[str, object]
) -> Candidate:
    middle = next(job for job in jobs if job.overrides == row.overrides)
    result = middle.result or {}
    storage = result.get("storage", "float32")  # of a run from before there was a choice

    def networks() -> Networks:
        return quantised(networks_trained_on(files, middle.folder / "checkpoints" / "last.ckpt"), storage)

    if row.seeds > 1:
        low, high = (f"{error:.3g} mm" if math.isfinite(error) else "no surface" for error in row.chamfer_l1_mm_mean_range)
        name += f", the middle one of {row.seeds} seeds ({low} to {high} in their runs, on {result['settings']['evaluation']['resolution']}^3 points)"
    is_default = storage == "float32" and all(result["settings"][part] == described(wanted) for part, wanted in asked.items())
    return _network_candidate(name, row.decoder_parameters, networks, trajectory, grid, is_default, overrides_alone(row.overrides))


def _errors(model: ShapeModel, trajectory: Trajectory, frames: Sequence[int], truth: SurfaceDistance, samples: int) -> tuple[float, float]:
    """chamfer_l1 (mm): mean over the frames and worst frame. Raises ReconstructionError where a frame has no surface."""
    errors: dict[int, SurfaceErrors] = {}
    for frame in frames:
        true, predicted = trajectory.surface(frame), model.surface(frame)
        truth.deform(true.vertices)
        errors[frame] = surface_errors(predicted, true, trajectory.mesh.diagonal, samples, true_distance=truth)
    summary = aggregate(errors)
    return summary["chamfer_l1_mm_mean"], summary["chamfer_l1_mm_worst"]


def _ask(model: ShapeModel, frames: Iterator[int], points: Tensor) -> None:
    model.distances(next(frames), points)


def _reconstruct(model: ShapeModel, frames: Iterator[int]) -> None:
    model.surface(next(frames))
