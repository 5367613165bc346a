"""How far a reconstructed surface is from the truth, as METRICS asks: every name carries its unit."""

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Float64
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from sdfnet.errors import ConfigurationError
from sdfnet.evaluation.field_errors import MILLIMETRES, EikonalErrors, FieldErrors, VolumeErrors
from sdfnet.geometry.distance import SurfaceDistance, morton_order
from sdfnet.geometry.surface import Surface

HIGHER_IS_BETTER = ("f_score_0p1_percent", "f_score_0p5_percent", "f_score_1_percent", "normal_cosine", "is_watertight", "intersection_over_union")


@dataclass(frozen=True)
class SurfaceErrors:
    """How far two surfaces lie apart. Distances run from samples of one surface to the triangles of the other."""

    accuracy_mm: float  # mean distance, predicted to true
    completeness_mm: float  # mean distance, true to predicted
    chamfer_l1_mm: float  # their mean
    rms_mm: float  # over both directions, as are the three below
    p99_mm: float
    hausdorff_mm: float
    normal_cosine: float  # between a sample's normal and the normal where it lands; -1 is inside out
    normal_degrees: float  # mean angle between the two
    f_score_0p1_percent: float  # 0 to 1: harmonic mean of the shares of samples within 0.1 % of D, one share a direction
    f_score_0p5_percent: float
    f_score_1_percent: float
    components: int  # of the predicted surface, as are the two below
    genus: int  # handles, summed over the components; -1 where the surface is open and has none
    is_watertight: bool  # every edge belongs to two faces that run along it in opposite directions


# What a frame without any surface scores: infinitely far from everything. It keeps a failure visible in every mean.
NO_SURFACE = SurfaceErrors(
    accuracy_mm=math.inf,
    completeness_mm=math.inf,
    chamfer_l1_mm=math.inf,
    rms_mm=math.inf,
    p99_mm=math.inf,
    hausdorff_mm=math.inf,
    normal_cosine=-1.0,
    normal_degrees=180.0,
    f_score_0p1_percent=0.0,
    f_score_0p5_percent=0.0,
    f_score_1_percent=0.0,
    components=0,
    genus=-1,
    is_watertight=False,
)


def surface_errors(
    predicted: Surface,
    true: Surface,
    diagonal: float,
    samples: int = 131_072,
    seed: int = 0,
    true_distance: SurfaceDistance | None = None,
) -> SurfaceErrors:
    """Compare a reconstructed surface with the truth; `diagonal` is D, the rest surface's, in m.

    `samples` area-uniform points on each surface look for the nearest triangle of the other, so that two identical
    surfaces differ by rounding only. `true_distance` is the truth's search tree, where there is one already.
    """
    onto_true = SurfaceDistance(true) if true_distance is None else true_distance
    accuracy, accuracy_cosine = _distances_and_cosines(predicted, onto_true, samples, seed)
    completeness, completeness_cosine = _distances_and_cosines(true, SurfaceDistance(predicted, is_closed=False), samples, seed)
    both, cosines = np.concatenate([accuracy, completeness]), np.concatenate([accuracy_cosine, completeness_cosine])
    components, genus, is_watertight = topology(predicted)
    return SurfaceErrors(
        accuracy_mm=MILLIMETRES * float(accuracy.mean()),
        completeness_mm=MILLIMETRES * float(completeness.mean()),
        chamfer_l1_mm=MILLIMETRES * float(accuracy.mean() + completeness.mean()) / 2,
        rms_mm=MILLIMETRES * float(np.sqrt(np.square(both).mean())),
        p99_mm=MILLIMETRES * float(np.quantile(both, 0.99)),
        hausdorff_mm=MILLIMETRES * float(both.max()),
        normal_cosine=float(cosines.mean()),
        normal_degrees=float(np.degrees(np.arccos(cosines.clip(-1, 1))).mean()),
        f_score_0p1_percent=_f_score(accuracy, completeness, 0.001 * diagonal),
        f_score_0p5_percent=_f_score(accuracy, completeness, 0.005 * diagonal),
        f_score_1_percent=_f_score(accuracy, completeness, 0.01 * diagonal),
        components=components,
        genus=genus,
        is_watertight=is_watertight,
    )


def vertex_errors(surface: Surface, true_distance: SurfaceDistance) -> Float64[np.ndarray, " vertices"]:
    """Distance of each vertex to the true surface, mm: what a picture is coloured by."""
    points = torch.from_numpy(surface.vertices.astype(np.float32))
    return MILLIMETRES * true_distance.signed_distance(points).abs().double().numpy()


def topology(surface: Surface) -> tuple[int, int, bool]:
    """Components, genus and watertightness: sum of genera = components - (vertices - edges + faces) / 2."""
    starts, ends = surface.faces.ravel(), np.roll(surface.faces, -1, axis=1).ravel()
    count = len(surface.vertices)
    directed = np.unique(starts * count + ends, return_counts=True)
    edges = np.unique(np.minimum(starts, ends) * count + np.maximum(starts, ends), return_counts=True)
    is_watertight = bool((directed[1] == 1).all() and (edges[1] == 2).all())
    used = np.unique(surface.faces)
    joined = coo_matrix((np.ones(len(edges[0]), dtype=bool), np.divmod(edges[0], count)), shape=(count, count))
    components = connected_components(joined, directed=False)[0] - (count - len(used))
    genus = components - (len(used) - len(edges[0]) + len(surface.faces)) // 2 if is_watertight else -1
    return int(components), int(genus), is_watertight


def aggregate(errors: Mapping[int, SurfaceErrors | VolumeErrors | FieldErrors | EikonalErrors]) -> dict[str, float | int]:
    """Mean, worst and worst frame of every metric over frames, keyed by frame number.

    Names are those of the metrics with `_mean`, `_worst` and `_worst_frame` added, beside `frames` and `failed_frames`.
    A frame with no surface enters as NO_SURFACE and makes the mean infinite: a failure is counted, never dropped.
    Raises ConfigurationError when there is no frame.
    """
    frames = list(errors)
    if not frames:
        raise ConfigurationError("a summary needs the errors of at least one frame, found none; choose frames to evaluate")
    summary: dict[str, float | int] = {"frames": len(frames), "failed_frames": sum(found == NO_SURFACE for found in errors.values())}
    for metric in dataclasses.fields(errors[frames[0]]):
        values = np.array([getattr(errors[frame], metric.name) for frame in frames], dtype=np.float64)
        worst = int(values.argmin() if metric.name in HIGHER_IS_BETTER else values.argmax())
        summary[f"{metric.name}_mean"] = float(values.mean())
        summary[f"{metric.name}_worst"] = float(values[worst])
        summary[f"{metric.name}_worst_frame"] = frames[worst]
    return summary


def _samples(surface: Surface, count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Points spread evenly over the area and the unit normals there, neighbours in space near each other in the arrays."""
    faces = surface.faces[morton_order(surface.vertices[surface.faces[:, 0]].astype(np.float32))]
    a, b, c = (surface.vertices[faces[:, corner]] for corner in range(3))
    normals = np.cross(b - a, c - a)
    doubled_areas = np.linalg.norm(normals, axis=1)
    generator = np.random.default_rng(seed)
    face = np.repeat(np.arange(len(faces)), generator.multinomial(count, doubled_areas / doubled_areas.sum()))
    root, share = np.sqrt(generator.random((count, 1))), generator.random((count, 1))
    points = (1 - root) * a[face] + root * (1 - share) * b[face] + root * share * c[face]
    return points.astype(np.float32), (normals / np.maximum(doubled_areas, np.finfo(np.float64).tiny)[:, None])[face]


def _distances_and_cosines(sampled: Surface, other: SurfaceDistance, samples: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Distance (m) of samples of one surface to the other, and the cosine between both normals."""
    points, normals = _samples(sampled, samples, seed)
    closest = other.closest(torch.from_numpy(points), within=math.inf)
    return closest.distance.double().numpy(), np.einsum("ij,ij->i", normals, closest.normals.double().numpy())


def _f_score(accuracy: np.ndarray, completeness: np.ndarray, threshold: float) -> float:
    """Harmonic mean of precision and recall at a distance; 0 where both are."""
    precision, recall = float((accuracy <= threshold).mean()), float((completeness <= threshold).mean())
    return 2 * precision * recall / (precision + recall) if precision + recall > 0 else 0.0
