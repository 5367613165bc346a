"""What one query costs in batches of one, a thousand and a million: a network beside the exact query on the deformed mesh and KNN-1."""

import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial

import numpy as np
import torch
from jaxtyping import Float32
from torch import Tensor

from sdfnet.cost.distance_study import exact_distances, package
from sdfnet.cost.field_baselines import NearestSampleField, NetworkField
from sdfnet.cost.studies import Point, Study, Timing, interleaved
from sdfnet.data.store import DistanceSamples
from sdfnet.errors import ConfigurationError
from sdfnet.evaluation.metrics import MILLIMETRES
from sdfnet.geometry.distance import SurfaceDistance
from sdfnet.geometry.surface import Surface
from sdfnet.models.networks import Networks
from sdfnet.physics.trajectory import Trajectory

BATCHES = (1, 1_000, 1_000_000)
CORES = (1, 2)
MOST_CALLS = 200  # of small batches in one timing, so that the clock and a cold cache do not count
REPEATS = 5
REFERENCE = "libigl, mesh"
ERROR_POINTS = 20_000  # near the surface, for the error of an answer
Answer = Callable[[Float32[Tensor, "points 3"]], Float32[Tensor, " points"]]


def query_study(networks: Networks, trajectory: Trajectory, samples: DistanceSamples, frame: int = -1, quick: bool = False) -> Study:
    """Seconds of one query at points of the sampling box, all methods in turns, on one core and on two.

    The frame stands still: hierarchies, trees and latents are ready; what a change of frame costs is in `measured_shapes`
    and, for the mesh, in the point "refitted for each batch". Points come in Morton order, which suits the mesh and
    KNN-1 and is all one to a network. The error is the mean over samples near the surface, against libigl in float64.
    Raises ConfigurationError when libigl is not installed; it comes with sdfnet's dev extra.
    """
    frame %= len(trajectory.times)
    batches = BATCHES[:2] if quick else BATCHES
    answers = _answers(networks, trajectory, samples, frame)
    near = samples.near_points[:: max(1, len(samples.near_points) // ERROR_POINTS)]
    true = exact_distances(near, trajectory.surface(frame))
    errors = {method: MILLIMETRES * float(np.abs(answer(torch.from_numpy(near)).numpy() - true).mean()) for method, answer in answers.items()}
    points = []
    for count in [count for count in CORES if count <= len(available_cores())]:
        with on_cores(count):
            timings = query_seconds(answers, torch.from_numpy(samples.points), batches, 2 if quick else REPEATS)
        named = f"{count} core{'s' * (count > 1)}"
        points += [
            Point(f"{method}, {named}", f"batch {batch:,}", errors[method], timing, {"queries": batch}, is_reference=method == REFERENCE)
            for (method, batch), timing in timings.items()
        ]
    return Study(
        "query",
        "network",
        "One query in batches of one, a thousand and a million",
        "mean error of the distance near the surface against libigl in float64 (mm)",
        "one query (s)",
        tuple(points),
    )


def query_seconds(answers: Mapping[str, Answer], points: Float32[Tensor, "points 3"], batches: Sequence[int], repeats: int) -> dict[tuple[str, int], Timing]:
    """Seconds of one query by method and batch size. Batches larger than `points` repeat them; small ones are spread over them."""
    tasks, asked = {}, {}
    for batch in batches:
        calls = max(1, min(MOST_CALLS, MOST_CALLS * BATCHES[1] // 10 // batch))
        chosen = torch.arange(batch * calls) * len(points) // (batch * calls)
        parts = points[chosen].split(batch)
        for method, answer in answers.items():
            tasks[f"{method} {batch}"] = partial(_answer_all, answer, parts)
            asked[f"{method} {batch}"] = (method, batch, batch * calls)
    found = interleaved(tasks, repeats)
    return {(method, batch): found[name].divided_by(count) for name, (method, batch, count) in asked.items()}


@contextmanager
def on_cores(count: int) -> Iterator[None]:
    """Bind this thread and those that it starts meanwhile to `count` cores, and PyTorch to as many threads; as it was afterwards.

    Threads that run already, such as those of PyTorch's pool, are not bound: on one core PyTorch uses none of them, on
    more it uses as many as are wanted, on cores of the system's choice. Raises ConfigurationError when there are fewer
    cores. Where the system cannot bind threads (macOS, Windows) only PyTorch is held.
    """
    allowed, threads = available_cores(), torch.get_num_threads()
    if count > len(allowed):
        raise ConfigurationError(f"a timing on {count} cores needs as many, found {len(allowed)}; ask for fewer")
    bind = getattr(os, "sched_setaffinity", lambda process, cores: None)
    bind(0, allowed[:count])
    torch.set_num_threads(count)
    try:
        yield
    finally:
        bind(0, allowed)
        torch.set_num_threads(threads)


def available_cores() -> list[int]:
    """Numbers of the cores that this process may use."""
    return sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else list(range(os.cpu_count() or 1))


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
        REFERENCE: _libigl(surface),
    }


def _libigl(surface: Surface) -> Answer:
    """libigl's pseudonormal distance in float64: for one point by its kept tree, for more by its own call, which builds the tree each time."""
    igl = package("igl", "libigl")
    vertices, faces = surface.vertices, surface.faces
    tree = igl.AABB()
    tree.init(vertices, faces)
    face_normals = igl.per_face_normals(vertices, faces, np.zeros(3))
    vertex_normals = igl.per_vertex_normals(vertices, faces, igl.PER_VERTEX_NORMALS_WEIGHTING_TYPE_ANGLE, face_normals)
    edge_normals, _, edge_of = igl.per_edge_normals(vertices, faces, igl.PER_EDGE_NORMALS_WEIGHTING_TYPE_UNIFORM)

    three = np.arange(3)

    def answer(points: Tensor) -> Tensor:
        asked = points.double().numpy()
        if len(asked) > 1:
            return torch.from_numpy(exact_distances(points.numpy(), surface)).float()
        squared, found, closest = tree.squared_distance(vertices, faces, asked)
        # Only what belongs to the face is handed over: the binding copies its arguments, which cost ten times the search.
        face = int(found[0])
        corners, edges = faces[face], edge_of.reshape(3, -1)[:, face]
        of_face = (face_normals[[face]], vertex_normals[corners], edge_normals[edges], three[:, None])
        sign, _ = igl.pseudonormal_test(vertices[corners], three[None], *of_face, asked, closest, 0)
        return torch.from_numpy(sign * np.sqrt(squared)).float()

    return answer


def _answer_all(answer: Answer, parts: Sequence[Tensor]) -> None:
    for part in parts:
        answer(part)
