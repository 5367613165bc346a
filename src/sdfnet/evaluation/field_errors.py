"""How far a signed distance field, and the solid that it bounds, are from the truth, as METRICS asks: every name carries its unit."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float32, Float64
from torch import Tensor

from sdfnet.errors import ReconstructionError

MILLIMETRES = 1e3  # in a metre


@dataclass(frozen=True)
class VolumeErrors:
    """How far two solids differ, by counting uniform points inside them."""

    intersection_over_union: float  # 0 to 1
    volume_error_percent: float  # size of the difference of volumes, of the true volume


@dataclass(frozen=True)
class FieldErrors:
    """How far two signed distances differ, over all points and over those near the surface."""

    mae_mm: float
    rmse_mm: float
    max_mm: float
    mae_within_5_percent_mm: float  # where the true distance is below 5 % of D; nan where no point is, as below
    rmse_within_5_percent_mm: float
    max_within_5_percent_mm: float
    mae_within_1_percent_mm: float
    rmse_within_1_percent_mm: float
    max_within_1_percent_mm: float
    sign_error_percent: float  # share of points on the wrong side of the surface


@dataclass(frozen=True)
class EikonalErrors:
    """How far a field is from a true distance, whose gradient has length one: statistics of | |grad f| - 1 |."""

    eikonal_mean: float
    eikonal_p99: float


def volume_errors(
    predicted_inside: Callable[[Float32[Tensor, "points 3"]], Bool[Tensor, " points"]],
    true_inside: Callable[[Float32[Tensor, "points 3"]], Bool[Tensor, " points"]],
    lower: Float64[np.ndarray, "3"],
    upper: Float64[np.ndarray, "3"],
    samples: int = 1_000_000,
    seed: int = 0,
) -> VolumeErrors:
    """Compare two solids, given as functions that say which points are inside, by uniform points in a box about both.

    `lower` and `upper` (m) are the corners of a box that holds both. Raises ReconstructionError when no point falls
    inside the true solid. With n of them inside, the volume is known to about one part in sqrt(n).
    """
    points = torch.from_numpy(np.random.default_rng(seed).uniform(lower, upper, (samples, 3)).astype(np.float32))
    predicted, true = predicted_inside(points), true_inside(points)
    volume = int(true.sum())
    if volume == 0:
        raise ReconstructionError(f"the true solid must fill part of the box, found none of {samples} points inside; check the box and the sign convention")
    return VolumeErrors(
        intersection_over_union=int((predicted & true).sum()) / int((predicted | true).sum()),
        volume_error_percent=100 * abs(int(predicted.sum()) - volume) / volume,
    )


def field_errors(predicted: Float32[Tensor, " points"], true: Float32[Tensor, " points"], diagonal: float) -> FieldErrors:
    """Compare signed distances (m) at the same points; `diagonal` is D in m."""
    error, depth = (predicted.double() - true.double()).abs() * MILLIMETRES, true.abs()
    everywhere, around, near = (_mean_rms_max(error[depth < band]) for band in (math.inf, 0.05 * diagonal, 0.01 * diagonal))
    wrong_side = ((predicted < 0) != (true < 0)).double().mean()
    return FieldErrors(*everywhere, *around, *near, 100 * float(wrong_side))


def eikonal_error(field: Callable[[Float32[Tensor, "points 3"]], Float32[Tensor, " points"]], points: Float32[Tensor, "points 3"]) -> EikonalErrors:
    """Mean and 99th percentile of | |grad f| - 1 | at `points`, the gradient by automatic differentiation.

    Zero for a true distance except on its ridges, so the exact distance itself scores above zero there.
    """
    with torch.inference_mode(False), torch.enable_grad():
        query = points.detach().clone().requires_grad_()
        (gradient,) = torch.autograd.grad(field(query).sum(), query)
    deviation = (gradient.norm(dim=1) - 1).abs().double().numpy()
    return EikonalErrors(float(deviation.mean()), float(np.quantile(deviation, 0.99)))


def _mean_rms_max(error: Tensor) -> tuple[float, float, float]:
    if len(error) == 0:
        return (math.nan,) * 3
    return float(error.mean()), float(error.square().mean().sqrt()), float(error.max())
