"""How a query point enters the SDF Calculator: as it is, as Fourier features (the paper's first suggestion), or as learned features on a grid."""

import math

import torch
from jaxtyping import Float, Float32
from torch import Tensor, nn

from sdfnet.models.grid_features import GridFeatures
from sdfnet.models.settings import ModelSettings

SMALLEST_QUANTILE = 1e-4  # keeps the inverse error function finite: no frequency beyond 3.7 deviations


class IdentityEncoding(nn.Module):
    """The point itself, three features."""

    features = 3

    def forward(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch 3"]:
        """Return the points."""
        return points


class FourierFeatures(nn.Module):
    """Sines and cosines of fixed directions (Tancik et al. 2020): [sin(B x), cos(B x)], B normal with deviation pi * scale.

    B is drawn from a scrambled Sobol sequence, which leaves no gaps and no clumps, with its own seed; it is saved with
    the weights and counted in the decoder's size. It lets a small network show detail of about 1 / scale of the box's
    half side; much larger scales ring. With `include_input` the point itself and its distance from the centre come
    first: waves alone do not grow with the distance, and fewer than thirty of them leave surfaces far from the solid.
    """

    frequencies: Tensor

    def __init__(self, frequencies: int, scale: float, include_input: bool = False, seed: int = 0) -> None:
        super().__init__()
        self.include_input = include_input
        self.features = 2 * frequencies + (4 if include_input else 0)
        uniform = torch.quasirandom.SobolEngine(3, scramble=True, seed=seed).draw(frequencies).clamp(SMALLEST_QUANTILE, 1 - SMALLEST_QUANTILE)
        normal = math.sqrt(2) * torch.erfinv(2 * uniform - 1)
        self.register_buffer("frequencies", math.pi * scale * normal.T.contiguous())

    def forward(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch features"]:
        """Encode points given in mean half sides of the box."""
        with torch.autocast(points.device.type, enabled=False):  # the phase needs float32: bf16 would be wrong by a tenth of a radian
            phase = points @ self.frequencies
            waves = [torch.sin(phase), torch.cos(phase)]
            inputs = [points, torch.linalg.vector_norm(points, dim=-1, keepdim=True)] if self.include_input else []
        return torch.cat([*inputs, *waves], dim=-1)


Encoding = IdentityEncoding | FourierFeatures | GridFeatures


def encoding_of(settings: ModelSettings, extent: Float32[Tensor, "3"]) -> Encoding:
    """The encoding that the settings name, for points in a box with these half sides, both in mean half sides."""
    if settings.encoding == "none":
        return IdentityEncoding()
    if settings.encoding == "fourier":
        return FourierFeatures(settings.frequencies, settings.fourier_scale, settings.include_input)
    resolutions = settings.grid_resolutions
    table_size = settings.grid_table_size if settings.encoding == "hash_grid" else (resolutions[0] + 1) ** 3
    return GridFeatures(resolutions, settings.grid_features, table_size, extent)
