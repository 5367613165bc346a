"""What accuracy costs in signed distances: methods and precisions beside libigl in float64."""

import importlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch
import trimesh
from jaxtyping import Bool, Float32, Float64
from scipy.spatial import cKDTree

from sdfnet.cost.studies import Point, Study, Timing, interleaved
from sdfnet.data.sampling import box_points, near_surface_points, sampling_box
from sdfnet.errors import ConfigurationError, SdfnetError
from sdfnet.geometry.distance import SurfaceDistance
from sdfnet.geometry.surface import Surface
from sdfnet.physics.trajectory import Trajectory
from sdfnet.scene import Sampling

Answer = Callable[[np.ndarray], np.ndarray]  # signed distances (m) of points (points, 3)

REPEATS = 3
MILLION = 1_000_000
FEW = 500  # queries that dear methods are asked
CLEAR = 1e-6  # m: nearer to the surface than the float32 coordinates of a metre-sized solid resolve, either sign is right
SAMPLE_COUNTS = (1_000, 10_000, 100_000)


@dataclass(frozen=True, eq=False)
class Queries:
    """Where all methods are asked, in the proportion in which a dataset asks."""

    points: Float32[np.ndarray, "points 3"]  # m
    is_near: Bool[np.ndarray, " points"]  # drawn about the surface and not in the box

    def every(self, stride: int) -> "Queries":
        """A part that is spread evenly over all."""
        return Queries(self.points[::stride], self.is_near[::stride])


@dataclass(frozen=True)
class _Method:
    """One way to answer."""

    name: str
    setting: str
    answer: Answer
    is_dear: bool = False
    is_default: bool = False
    is_reference: bool = False


def distance_study(trajectory: Trajectory, sampling: Sampling | None = None, count: int = 100_000, frame: int = -1) -> Study:
    """Ways to the signed distances of one deformed frame, against libigl's with pseudo-normals in float64 at the same points.

    The error is the root mean square over the points; wrong signs are counted apart for points of the box and near the surface.
    Seconds hold all that a new frame asks for: refit, rebuilding or sampling once, and the queries at the rate of those asked. Approximations take the
    nearest vertex or sample and the side on which its normal says that the point lies. Packages that are not installed are failed
    points. Raises ConfigurationError without libigl, which comes with sdfnet's cost extra, or for a frame without one before it.
    """
    frame = range(len(trajectory.times))[frame]
    if frame == 0:
        raise ConfigurationError("a distance study needs a frame with another before it, found frame 0; take a later one")
    sampling = Sampling() if sampling is None else sampling
    queries = query_points(trajectory, frame, sampling, count)
    exact = exact_distances(queries.points, trajectory.surface(frame))
    stride = max(1, count // FEW)
    methods = [*_ours(trajectory, frame, queries.points), *_libigls(trajectory.surface(frame)), *_others(trajectory.surface(frame))]
    points, tasks = [], {}
    for method in methods:
        asked, truth = (queries.every(stride), exact[::stride]) if method.is_dear else (queries, exact)
        points.append(_measured(method, asked, truth))
        if points[-1].failure is None:
            tasks[_name(points[-1])] = partial(method.answer, asked.points)
            tasks[_set_up(points[-1])] = partial(method.answer, asked.points[:1])
    timings = interleaved(tasks, REPEATS, warm_up=0)  # each has been asked once
    return Study(
        name="distances",
        title="What signed distances cost",
        error_label="RMS error of the signed distance against libigl in float64 (mm)",
        cost_label="for a million queries about a new frame (s)",
        points=tuple(_timed(point, timings[_name(point)], timings[_set_up(point)]) if _name(point) in timings else point for point in points),
        share_of_whole=MILLION / (len(trajectory.times) * (sampling.count + sampling.near_surface_count)),
    )


def query_points(trajectory: Trajectory, frame: int, sampling: Sampling, count: int) -> Queries:
    """`count` points of a dataset's own sampler, those of the box first, in the dataset's proportion; near-surface ones lie about the frame."""
    near_count = round(count * sampling.near_surface_count / (sampling.count + sampling.near_surface_count))
    drawn = replace(sampling, count=count - near_count, near_surface_count=near_count)
    vertices, mesh = trajectory.surface_vertices, trajectory.mesh
    box = sampling_box(vertices, sampling.box_scale)
    near = near_surface_points(vertices[[frame]], mesh.surface_faces, box, sampling.near_surface_spread * mesh.diagonal, drawn)
    return Queries(np.concatenate([box_points(box, drawn), near]), np.arange(count) >= count - near_count)


def exact_distances(points: Float32[np.ndarray, "points 3"], surface: Surface) -> Float64[np.ndarray, " points"]:
    """libigl's, in float64 with pseudo-normals: another hierarchy, other code and other precision than sdfnet's.

    Raises ConfigurationError when libigl is not installed.
    """
    return _libigl(surface, "PSEUDONORMAL")(points)


def package(name: str, project: str) -> Any:
    """An optional package. Raises ConfigurationError when it, or what it needs itself, such as a library of the system, is not installed."""
    try:
        return importlib.import_module(name)
    except (ImportError, OSError) as error:
        raise ConfigurationError(f"this method needs {project}, which could not be imported ({error}); pip install 'sdfnet[cost]'") from error


def _measured(method: _Method, queries: Queries, exact: Float64[np.ndarray, " points"]) -> Point:
    point = Point(method.name, method.setting, counts={"queries": len(exact)}, is_default=method.is_default, is_reference=method.is_reference)
    try:
        found = method.answer(queries.points)
    except SdfnetError as error:
        return replace(point, failure=str(error))
    wrong = (np.sign(found) != np.sign(exact)) & (np.abs(exact) > CLEAR)
    signs = {"box_sign_errors": int(wrong[~queries.is_near].sum()), "near_surface_sign_errors": int(wrong[queries.is_near].sum())}
    return replace(point, error_mm=float(1e3 * np.sqrt(((found - exact) ** 2).mean())), counts={**point.counts, **signs})


def _timed(point: Point, timing: Timing, set_up: Timing) -> Point:
    """With the seconds of one set-up, which a single query shows, and of a million queries at the rate of those asked."""
    more = MILLION / point.counts["queries"] - 1

    def of_million(seconds: float) -> float:
        return seconds + more * max(0.0, seconds - set_up.median)  # clocks are noisy; a million take no less than those asked

    return replace(point, seconds=Timing(of_million(timing.median), of_million(timing.p5), of_million(timing.p95), timing.repeats))


def _name(point: Point) -> str:
    return f"{point.method}, {point.setting}"


def _set_up(point: Point) -> str:
    return f"{_name(point)}, one query"


def _ours(trajectory: Trajectory, frame: int, points: Float32[np.ndarray, "points 3"]) -> list[_Method]:
    """As `sdfnet.data.prepare` asks, whose hierarchy is built at frame 0 and has come to the frame before, and without what it saves."""
    surface, before = trajectory.surface(frame), trajectory.surface(frame - 1)
    moving = SurfaceDistance(trajectory.surface(0))
    moving.deform(before.vertices)
    last = moving.signed_distance(torch.from_numpy(points)).abs()
    bound = last + float(np.linalg.norm(surface.vertices - before.vertices, axis=1).max())

    def refitted(asked: np.ndarray, upper_bound: torch.Tensor | None = None) -> np.ndarray:
        moving.deform(surface.vertices)
        return moving.signed_distance(torch.from_numpy(asked), upper_bound).numpy()

    def rebuilt(asked: np.ndarray) -> np.ndarray:
        return SurfaceDistance(surface).signed_distance(torch.from_numpy(asked)).numpy()

    name = "Warp hierarchy, float32"
    return [
        _Method(name, "refitted, searched as far as the last frame allows", lambda asked: refitted(asked, bound[: len(asked)]), is_default=True),
        _Method(name, "refitted", refitted),
        _Method(name, "rebuilt", rebuilt),
    ]


def _libigls(surface: Surface) -> list[_Method]:
    """The reference, its other ways to the sign, and what rounding costs.

    Winding numbers give the reference's distances but for points whose sign they get wrong. Fast ones do not: libigl multiplies
    the distance with a sign that is only nearly one.
    """
    rounded = Surface(surface.vertices.astype(np.float32).astype(np.float64), surface.faces)
    return [
        _Method("libigl, float64", "sign by pseudo-normals", _libigl(surface, "PSEUDONORMAL"), is_reference=True),
        _Method("libigl, float64", "sign by fast winding numbers", _libigl(surface, "FAST_WINDING_NUMBER")),
        _Method("libigl, float64", "sign by winding numbers", _libigl(surface, "WINDING_NUMBER"), is_dear=True, is_reference=True),
        _Method("libigl, float64", "sign by pseudo-normals, vertices rounded to float32", _libigl(rounded, "PSEUDONORMAL")),
    ]


def _libigl(surface: Surface, sign: str) -> Answer:
    igl = package("igl", "libigl")
    kind = getattr(igl, f"SIGNED_DISTANCE_TYPE_{sign}")
    return lambda asked: igl.signed_distance(asked.astype(np.float64), surface.vertices, surface.faces, sign_type=kind)[0]


def _others(surface: Surface) -> list[_Method]:
    """What else one would reach for: exact libraries, and nearest neighbours among vertices or samples."""
    nearest = "scipy cKDTree, float64"
    return [
        _Method("trimesh, float64", "proximity.signed_distance", partial(_trimeshs, surface), is_dear=True),
        _Method("Open3D, float32", "RaycastingScene", partial(_open3ds, surface)),
        _Method(nearest, f"{len(surface.vertices):,} vertices", partial(_to_vertices, surface)),
        *(_Method(nearest, f"{count:,} samples", partial(_to_samples, surface, count)) for count in SAMPLE_COUNTS),
    ]


def _trimeshs(surface: Surface, asked: np.ndarray) -> np.ndarray:
    package("rtree", "rtree")  # of which trimesh makes its own hierarchy
    result: np.ndarray = -trimesh.proximity.signed_distance(surface.as_trimesh(), asked)  # positive inside
    return result


def _open3ds(surface: Surface, asked: np.ndarray) -> np.ndarray:
    open3d = package("open3d", "open3d")
    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(open3d.core.Tensor(surface.vertices.astype(np.float32)), open3d.core.Tensor(surface.faces.astype(np.uint32)))
    result: np.ndarray = scene.compute_signed_distance(open3d.core.Tensor(asked)).numpy()
    return result


def _to_vertices(surface: Surface, asked: np.ndarray) -> np.ndarray:
    return _to_nearest(surface.vertices, np.asarray(surface.as_trimesh().vertex_normals), asked)


def _to_samples(surface: Surface, count: int, asked: np.ndarray) -> np.ndarray:
    mesh = surface.as_trimesh()
    samples, faces = trimesh.sample.sample_surface(mesh, count, seed=0)
    return _to_nearest(np.asarray(samples), np.asarray(mesh.face_normals)[faces], asked)


def _to_nearest(places: np.ndarray, normals: np.ndarray, asked: np.ndarray) -> np.ndarray:
    """Distance to the nearest of some places, negative where the point lies behind its normal."""
    distances, nearest = cKDTree(places).query(asked, workers=-1)
    is_behind = ((asked - places[nearest]) * normals[nearest]).sum(axis=1) < 0
    return np.where(is_behind, -distances, distances)
