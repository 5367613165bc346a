"""How a query point enters the SDF Calculator: as it is, or as Fourier features (the paper's first suggestion)."""

import math

import torch
from jaxtyping import Float
from torch import Tensor, nn

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
    half side; much larger scales ring.
    """

    frequencies: Tensor

    def __init__(self, frequencies: int, scale: float, seed: int = 0) -> None:
        super().__init__()
        self.features = 2 * frequencies
        uniform = torch.quasirandom.SobolEngine(3, scramble=True, seed=seed).draw(frequencies).clamp(SMALLEST_QUANTILE, 1 - SMALLEST_QUANTILE)
        normal = math.sqrt(2) * torch.erfinv(2 * uniform - 1)
        self.register_buffer("frequencies", math.pi * scale * normal.T.contiguous())

    def forward(self, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch features"]:
        """Encode points given in mean half sides of the box."""
        with torch.autocast(points.device.type, enabled=False):  # the phase needs float32: bf16 would be wrong by a tenth of a radian
            phase = points @ self.frequencies
        return torch.cat([torch.sin(phase), torch.cos(phase)], dim=-1)


def encoding_of(kind: str, frequencies: int, scale: float) -> IdentityEncoding | FourierFeatures:
    """The encoding by its name in the settings."""
    return IdentityEncoding() if kind == "none" else FourierFeatures(frequencies, scale)
