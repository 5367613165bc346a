"""The networks beside KNN-1 and the marching-cubes floor, frame by frame (paper, Results)."""

import logging
import math
import time
from collections.abc import Callable, Collection
from dataclasses import dataclass, field
from functools import partial

import numpy as np
import torch
from jaxtyping import Float, Float32
from torch import Tensor

from sdfnet.data.store import DistanceSamples
from sdfnet.errors import ReconstructionError
from sdfnet.evaluation.baselines import NearestSample, nearest_sample_bytes
from sdfnet.evaluation.field_errors import EikonalErrors, FieldErrors, VolumeErrors, eikonal_error, field_errors, volume_errors
from sdfnet.evaluation.metrics import NO_SURFACE, SurfaceErrors, aggregate, surface_errors
from sdfnet.evaluation.reconstruct import Grid, surface_from_values
from sdfnet.evaluation.settings import EvaluationSettings
from sdfnet.evaluation.sparse import SparseValues, exact_values
from sdfnet.evaluation.sparse_network import SparseReconstruction
from sdfnet.geometry.distance import SurfaceDistance
from sdfnet.geometry.surface import Surface
from sdfnet.models.networks import Networks
from sdfnet.models.quantise import quantised
from sdfnet.physics.trajectory import Trajectory

logger = logging.getLogger(__name__)

PREFIX = {"network": "", "knn1": "knn1_", "floor": "floor_"}  # of a method's metrics in the result
METHODS = tuple(PREFIX)
EIKONAL_POINTS = 20_000


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Errors of every method at every measured frame, and the surfaces of the frames that were asked for."""

    networks: Networks  # as they were measured: rounded to the storage that was asked for
    surface_errors: dict[str, dict[int, SurfaceErrors]]  # by method, then frame
    field_errors: dict[int, FieldErrors]
    volume_errors: dict[int, VolumeErrors]
    eikonal_errors: dict[int, EikonalErrors]
    surfaces: dict[int, dict[str, Surface]]  # by frame, then truth or method
    knn1_bytes: int  # for all frames
    distinct_latents: int  # of all frames, as stored: 1 when the encoder tells no frame from another
    seconds: dict[str, float] = field(default_factory=dict)
    failures: dict[int, str] = field(default_factory=dict)  # by frame, why the network has no surface there

    def summary(self, unseen_frames: list[int]) -> dict[str, float | int]:
        """Every metric over the frames: the network's by its own name, the others with `knn1_` and `floor_` before it.

        Frames that were not trained on are summed up again with `unseen_` before the name.
        """
        summary: dict[str, float | int] = {}
        for method, errors in self.surface_errors.items():
            prefix = PREFIX[method]
            summary |= {prefix + name: value for name, value in aggregate(errors).items()}
            unseen = {frame: errors[frame] for frame in unseen_frames if frame in errors}
            if unseen:
                summary |= {f"unseen_{prefix}{name}": value for name, value in aggregate(unseen).items()}
        for fields in (aggregate(self.field_errors), aggregate(self.volume_errors)):
            summary |= {name: value for name, value in fields.items() if name not in ("frames", "failed_frames")}
        for name in ("eikonal_mean", "eikonal_p99"):
            summary[name] = float(np.mean([getattr(found, name) for found in self.eikonal_errors.values()]))
        summary["distinct_latents"] = self.distinct_latents
        reference = summary["knn1_chamfer_l1_mm_mean"]
        summary["skill"] = 1 - summary["chamfer_l1_mm_mean"] / reference if math.isfinite(reference) else math.nan
        return summary


def evaluate(
    networks: Networks,
    trajectory: Trajectory,
    samples: DistanceSamples,
    settings: EvaluationSettings,
    progress: Callable[[int, int], None] | None = None,
    unseen_frames: Collection[int] = (),
) -> Evaluation:
    """Reconstruct and measure frames by the network, by KNN-1 on the paper's sampling, and from the exact distance.

    Which frames `settings.every` says; the last and `unseen_frames`, those never trained on, are always among them. All three are
    marched on one grid over the sampling box. A network without a surface in a frame is counted as a failure there.
    Raises TrainingError for numbers that the storage cannot hold.
    `progress(done, total)` is called after every frame.
    """
    frames, wanted = _measured_and_wanted(settings, len(trajectory.times), unseen_frames)
    volume_frames = {frames[round(k)] for k in np.linspace(len(frames) - 1, 0, settings.volume_frames)}  # of one the last
    mesh = trajectory.mesh
    vertices = torch.from_numpy(trajectory.surface_vertices.astype(np.float32))
    grid = Grid(samples.box.lower, samples.box.upper, settings.resolution)
    clock = _Clock()
    networks = quantised(networks.eval().cpu(), settings.storage)
    latents = networks.latents(vertices)
    distinct_latents = _distinct(latents, vertices)
    latents = latents[frames]
    marched = _Marched(networks, latents, samples, grid, clock)
    truth = SurfaceDistance(trajectory.surface(0))
    by_method: dict[str, dict[int, SurfaceErrors]] = {method: {} for method in METHODS}
    evaluation = Evaluation(networks, by_method, {}, {}, {}, {frame: {} for frame in wanted}, nearest_sample_bytes(samples.kept), distinct_latents)
    for place, frame in enumerate(frames):
        true = trajectory.surface(frame)
        truth.deform(true.vertices)
        clock.stop("truth")
        fields = marched.fields(latents[place], frame, truth)
        surfaces = {method: _surface_or_none(found, grid, method, frame, evaluation.failures) for method, found in fields.items()}
        clock.stop("marching_cubes")
        surfaces["network"] = marched.refined(surfaces["network"], latents[place], settings.refine_steps)
        for method, surface in surfaces.items():
            errors = NO_SURFACE if surface is None else surface_errors(surface, true, mesh.diagonal, settings.surface_samples, true_distance=truth)
            evaluation.surface_errors[method][frame] = errors
        clock.stop("surface_errors")
        if frame in wanted:
            evaluation.surfaces[frame] |= {"truth": true} | {method: surface for method, surface in surfaces.items() if surface is not None}
        if frame in volume_frames:
            _measure_field(evaluation, latents[place], truth, samples, frame, mesh.diagonal, settings)
        clock.stop("field_and_volume_errors")
        if progress is not None:
            progress(place + 1, len(frames))
    evaluation.seconds.update(clock.seconds)
    return evaluation


def _distinct(latents: Float[Tensor, "frames latent"], vertices: Float32[Tensor, "frames vertices 3"]) -> int:
    """How many latents differ; with a warning where different shapes share a single one."""
    count = len(latents.unique(dim=0))
    if count == 1 and not bool((vertices == vertices[0]).all()):
        logger.warning("every frame has the same latent: the network has learned one shape for all of them; with an encoder, lower optimizer.encoder_rate")
    return count


def measured_frames(count: int, every: int) -> list[int]:
    """Every `every`-th frame, and the last."""
    return sorted({*range(0, count, every), count - 1})


def _measured_and_wanted(settings: EvaluationSettings, count: int, unseen_frames: Collection[int]) -> tuple[list[int], set[int]]:
    settings.require_frames(count)
    wanted = {frame % count for frame in settings.mesh_frames}
    return sorted({*measured_frames(count, settings.every), *unseen_frames, *wanted}), wanted


def _surface_or_none(found: SparseValues, grid: Grid, method: str, frame: int, failures: dict[int, str]) -> Surface | None:
    try:
        return surface_from_values(torch.from_numpy(found.values), grid, found.start)
    except ReconstructionError as error:
        reason = str(error)
        if method == "network":
            reason = failures[frame] = _why_no_surface(found.values, reason)
        logger.warning("frame %d, %s: counted as failed: %s", frame, method, reason)
        return None


def _why_no_surface(values: Float32[np.ndarray, "x y z"], reason: str) -> str:
    """In words for who trains a network: no box would help one that has not learned yet."""
    if not np.isfinite(values).all():
        return reason
    lowest, highest = float(values.min()), float(values.max())
    gives = "only positive distances" if lowest >= 0 else "only negative distances" if highest < 0 else "negative distances out to the sides of the box"
    return f"no surface: the network gives {gives} ({lowest:.3g} to {highest:.3g} m); train longer"


def _measure_field(
    evaluation: Evaluation,
    latent: Tensor,
    truth: SurfaceDistance,
    samples: DistanceSamples,
    frame: int,
    diagonal: float,
    settings: EvaluationSettings,
) -> None:
    decoder = evaluation.networks.decoder
    predicted = partial(decoder.distances, latent)
    points = torch.from_numpy(np.concatenate([samples.points, samples.near_points]))
    true = torch.from_numpy(np.concatenate([samples.distances[frame], samples.near_distances[frame]]))
    evaluation.field_errors[frame] = field_errors(predicted(points), true, diagonal)
    evaluation.volume_errors[frame] = volume_errors(
        lambda asked: predicted(asked) < 0, lambda asked: truth.signed_distance(asked) < 0, samples.box.lower, samples.box.upper, settings.volume_samples
    )
    chosen = torch.from_numpy(np.random.default_rng(0).integers(0, len(points), EIKONAL_POINTS))
    evaluation.eikonal_errors[frame] = eikonal_error(lambda asked: decoder(latent[None], asked)[0], points[chosen])


class _Clock:
    """Seconds by name; each stop takes what passed since the last."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def stop(self, name: str) -> None:
        now = time.perf_counter()
        self.seconds[name] = self.seconds.get(name, 0.0) + now - self._last
        self._last = now


class _Marched:
    """What is marched on one grid, by method, frame after frame."""

    def __init__(self, networks: Networks, latents: Tensor, samples: DistanceSamples, grid: Grid, clock: _Clock) -> None:
        self._samples, self._grid, self._clock = samples, grid, clock
        self._network = SparseReconstruction.measured(networks.decoder, grid, latents)
        clock.stop("network_values")
        self._nearest = NearestSample(torch.from_numpy(samples.points), grid.points())
        clock.stop("knn1_values")

    def fields(self, latent: Tensor, frame: int, truth: SurfaceDistance) -> dict[str, SparseValues]:
        """The values of a frame; KNN-1's on the whole grid, for it jumps from sample to sample and no cell may be left out."""
        fields = {"network": self._network.values(latent)}
        self._clock.stop("network_values")
        nearest = self._nearest.values(torch.from_numpy(self._samples.distances[frame]), torch.from_numpy(self._samples.kept[frame]))
        fields["knn1"] = SparseValues(nearest.reshape(self._grid.shape).numpy(), (0, 0, 0), len(nearest))
        self._clock.stop("knn1_values")
        fields["floor"] = exact_values(truth, self._grid)
        self._clock.stop("floor_values")
        return fields

    def refined(self, surface: Surface | None, latent: Tensor, steps: int) -> Surface | None:
        """The network's surface of a frame with its vertices moved; as it is without steps."""
        if surface is None or not steps:
            return surface
        found = self._network.refined(surface, latent, steps)
        self._clock.stop("refinement")
        return found
