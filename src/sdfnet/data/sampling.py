"""Where the distance is asked for: the paper's box, density and filter (section 3), and points about the surface."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32, Float64, Int32, Int64
from scipy.optimize import brentq

from sdfnet.errors import ConfigurationError, StoreError
from sdfnet.geometry.distance import morton_order
from sdfnet.scene import Sampling

Z_TABLE = 4097  # nodes of the cumulative density of z; the error of linear interpolation is under 1e-7 of the box


@dataclass(frozen=True, eq=False)
class SamplingBox:
    """The axis-aligned box that is sampled and later reconstructed."""

    lower: Float64[np.ndarray, "3"]  # m
    upper: Float64[np.ndarray, "3"]  # m


def sampling_box(vertices: Float64[np.ndarray, "frames vertices 3"], scale: float) -> SamplingBox:
    """The largest (by volume) of the frames' bounding boxes, scaled about its centre (paper section 3: 1.5).

    Raises ConfigurationError when a frame leaves it, as a solid that flies can.
    """
    lower, upper = vertices.min(axis=1), vertices.max(axis=1)
    largest = int(np.argmax(np.prod(upper - lower, axis=1)))
    centre, half = (lower[largest] + upper[largest]) / 2, scale * (upper[largest] - lower[largest]) / 2
    outside = np.maximum(centre - half - lower, upper - centre - half).max(axis=1)
    if outside.max() >= 0:
        raise ConfigurationError(
            f"the sampling box must hold every frame, found frame {int(outside.argmax())} {outside.max():.3g} m outside it; raise dataset.sampling.box_scale"
        )
    return SamplingBox(centre - half, centre + half)


def box_points(box: SamplingBox, sampling: Sampling) -> Float32[np.ndarray, "points 3"]:
    """`sampling.count` points in Morton order: x and y uniform, z with density proportional to (z - z_min)^n + b (paper section 3)."""
    generator = np.random.default_rng([sampling.seed, 0])
    unit = generator.random((sampling.count, 3))
    height = np.linspace(0.0, box.upper[2] - box.lower[2], Z_TABLE)
    cumulative = height ** (sampling.z_exponent + 1) / (sampling.z_exponent + 1) + sampling.z_floor * height
    points = box.lower + unit * (box.upper - box.lower)
    points[:, 2] = box.lower[2] + np.interp(unit[:, 2] * cumulative[-1], cumulative, height)
    points = points.astype(np.float32)
    return points[morton_order(points)]


def near_surface_points(
    vertices: Float64[np.ndarray, "frames vertices 3"], faces: Int64[np.ndarray, "faces 3"], box: SamplingBox, spread: float, sampling: Sampling
) -> Float32[np.ndarray, "points 3"]:
    """`sampling.near_surface_count` points in Morton order, normal with deviation `spread` (m) about area-uniform points of random frames' surfaces.

    Points that leave the box are put back on its boundary.
    """
    generator = np.random.default_rng([sampling.seed, 1])
    count = sampling.near_surface_count
    rest = vertices[0][faces]
    areas = np.linalg.norm(np.cross(rest[:, 1] - rest[:, 0], rest[:, 2] - rest[:, 0]), axis=1)
    chosen = generator.choice(len(faces), count, p=areas / areas.sum())
    frames = generator.integers(0, len(vertices), count)
    corners = vertices[frames[:, None], faces[chosen]]
    points = np.einsum("pc,pcx->px", generator.dirichlet([1.0, 1.0, 1.0], count), corners)
    points = np.clip(points + generator.normal(0.0, spread, (count, 3)), box.lower, box.upper).astype(np.float32)
    return points[morton_order(points)] if count else points


def filter_weight(distances: Float32[np.ndarray, " points"], sampling: Sampling) -> Float32[np.ndarray, " points"]:
    """A point's weight: w (1 + |d|)^(-decay), w by side, d in metres (paper section 3)."""
    side = np.where(distances > 0, np.float32(sampling.weight_outside), np.float32(sampling.weight_inside))
    return (side * (1.0 + np.abs(distances)) ** np.float32(-sampling.decay)).astype(np.float32)


def keep_per_frame(distances: Float32[np.ndarray, "frames points"], sampling: Sampling) -> Int32[np.ndarray, "frames kept"]:
    """Which points each frame keeps, cut to the smallest frame's count (paper section 3); a frame's indices ascend.

    The paper does not print how a weight becomes a chance: here chance = min(1, s weight), with one s such that the rest
    frame keeps the fraction `sampling.kept_share`. Raises StoreError when a frame keeps none.
    """
    generator = np.random.default_rng([sampling.seed, 2])
    factor = _factor_for_share(filter_weight(distances[0], sampling), sampling.kept_share)
    kept = [np.flatnonzero(generator.random(len(row), dtype=np.float32) < factor * filter_weight(row, sampling)) for row in distances]
    smallest = min(len(row) for row in kept)
    if smallest == 0:
        raise StoreError("the sampling filter keeps no point of some frame; raise sampling.kept_share or sampling.count")
    chosen = [np.sort(generator.permutation(row)[:smallest]) for row in kept]
    return np.stack(chosen).astype(np.int32)


def _factor_for_share(weights: Float32[np.ndarray, " points"], share: float) -> float:
    def surplus(factor: float) -> float:
        return float(np.minimum(1.0, factor * weights).mean()) - share

    return float(brentq(surplus, 0.0, 1.0 / float(weights.min()), rtol=1e-6))
