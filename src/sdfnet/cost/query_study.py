"""What one query costs in batches of one, a thousand and a million: a network beside the exact query on the deformed mesh and KNN-1."""

from collections.abc import Callable, Mapping, Sequence
from functools import partial

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

from sdfnet.cost.distance_study import exact_distances, package
from sdfnet.cost.field_baselines import NearestSampleField, NetworkField
from sdfnet.cost.machine import available_cores, on_cores
from sdfnet.cost.studies import Point, Study, Timing, duration_text, interleaved
from sdfnet.cost.unseen_points import unseen_near_points
from sdfnet.data.store import DistanceSamples
from sdfnet.evaluation.metrics import MILLIMETRES
from sdfnet.geometry.distance import SurfaceDistance
from sdfnet.geometry.surface import Surface
from sdfnet.models.networks import Networks
from sdfnet.physics.trajectory import Trajectory

BATCHES = (1, 1_000, 1_000_000)
CORES = (1, 2)
MOST_CALLS, MOST_SMALL_QUERIES = 200, 20_000  # in one timing of small batches, so that the clock and a cold cache do not count
REPEATS = 5
LIBIGL = "libigl, mesh"
REBUILT_LIBIGL = "libigl, mesh, tree built for each batch"  # which takes tens of milliseconds: asked of no single point
Answer = Callable[[Float32[Tensor, "points 3"]], Float32[Tensor, " points"]]


def query_studies(networks: Networks, trajectory: Trajectory, samples: DistanceSamples, frame: int = -1, quick: bool = False) -> list[Study]:
    """Seconds of one query at points of the sampling box for each size of batch, all methods in turns, on one core and on two.

    The frame stands still: hierarchies, trees and latents are ready, except where the name says otherwise; what a change
    of frame costs is in `measured_shapes`. Points come in Morton order, which suits the mesh and KNN-1 and is all one to a
    network. The error is the mean over `unseen_near_points`, against libigl in float64 with signs by pseudo-normals.
    Raises ConfigurationError when libigl is not installed; it comes with sdfnet's cost extra.
    """
    frame %= len(trajectory.times)
    answers = _answers(networks, trajectory, samples, frame)
    near = unseen_near_points(trajectory, samples.box)
    true = exact_distances(near.numpy(), trajectory.surface(frame))
    errors = {method: MILLIMETRES * float(np.abs(answer(near).numpy() - true).mean()) for method, answer in answers.items()}
    points, repeats = torch.from_numpy(samples.points), 2 if quick else REPEATS
    return [_batch_study(batch, answers, errors, points, repeats) for batch in (BATCHES[:2] if quick else BATCHES)]


def _batch_study(batch: int, answers: Mapping[str, Answer], errors: Mapping[str, float], asked: Float32[Tensor, "points 3"], repeats: int) -> Study:
    """What one query of a batch costs, with the seconds of all methods in a sentence, of those too that are on no front.

    libigl is no reference here: its answers are rounded to float32 like all others, and its seconds count.
    """
    timed = {method: answer for method, answer in answers.items() if batch > 1 or method != REBUILT_LIBIGL}
    points, notes = [], []
    for count in [count for count in CORES if count <= len(available_cores())]:
        with on_cores(count):
            timings = query_seconds(timed, asked, batch, repeats)
        cores = f"{count} core{'s' * (count > 1)}"
        points += [Point(method, cores, errors[method], timing, {"queries": batch}) for method, timing in timings.items()]
        notes.append(f"One query on {cores}: {'; '.join(f'{method} {duration_text(timing.median)}' for method, timing in timings.items())}.")
    return Study(
        f"query_{batch}",
        f"One query in batches of {batch:,}",
        "mean error of the distance near the surface against libigl in float64 (mm)",
        "one query (s)",
        tuple(points),
        notes=tuple(notes),
    )


def query_seconds(answers: Mapping[str, Answer], points: Float32[Tensor, "points 3"], batch: int, repeats: int) -> dict[str, Timing]:
    """Seconds of one query by method. Batches larger than `points` repeat them; small ones are spread over them."""
    calls = max(1, min(MOST_CALLS, MOST_SMALL_QUERIES // batch))
    chosen = torch.arange(batch * calls) * len(points) // (batch * calls)
    parts = points[chosen].split(batch)
    found = interleaved({method: partial(_answer_all, answer, parts) for method, answer in answers.items()}, repeats)
    return {method: timing.divided_by(batch * calls) for method, timing in found.items()}


def _answers(networks: Networks, trajectory: Trajectory, samples: DistanceSamples, frame: int) -> dict[str, Answer]:
    """What answers at `frame`, by method."""
    surface = trajectory.surface(frame)
    exact = SurfaceDistance(surface)
    refitted = SurfaceDistance(surface)

    def after_refit(points: Tensor) -> Tensor:
        refitted.deform(surface.vertices)
        return refitted.signed_distance(points)

    return {
        "network": partial(NetworkField(networks, trajectory.surface_vertices).distances, frame),
        "Warp, mesh": exact.signed_distance,
        "Warp, mesh refitted for each batch": after_refit,
        "KNN-1": partial(NearestSampleField(samples).distances, frame),
        LIBIGL: _libigl(surface),
        REBUILT_LIBIGL: lambda points: torch.from_numpy(exact_distances(points.numpy(), surface)).float(),
    }


def _libigl(surface: Surface) -> Answer:
    """libigl's distance in float64 by a tree that is kept, signed by fast winding numbers: the only sign of many points for which it keeps what it builds."""
    igl = package("igl", "libigl")
    tree, winding = igl.AABB(), igl.FastWindingNumberBVH()
    tree.init(surface.vertices, surface.faces)
    winding.init(surface.vertices, surface.faces)

    def answer(points: Tensor) -> Tensor:
        asked = points.double().numpy()
        squared, _, _ = tree.squared_distance(surface.vertices, surface.faces, asked)
        return torch.from_numpy(np.where(winding.winding_number(asked) > 0.5, -1, 1) * np.sqrt(squared)).float()

    return answer


def _answer_all(answer: Answer, parts: Sequence[Tensor]) -> None:
    for part in parts:
        answer(part)
