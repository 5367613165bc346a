"""The SDF Calculator: a latent vector and a point in, the signed distance out (paper section 4, S(z_i, X) = d)."""

import torch
from jaxtyping import Float, Float32
from torch import Tensor, nn

from sdfnet.models.encodings import FourierFeatures, IdentityEncoding, encoding_of
from sdfnet.models.mlp import ACTIVATION_MODULES, mlp
from sdfnet.models.settings import ModelSettings

OUTPUT_UNIT = 0.1  # of the mean half side: 1 cm on the bunny


class SdfCalculator(nn.Module):
    """An MLP on the concatenation of latent vector and encoded point, written without the concatenation.

    The first layer is W_x enc(x) + (W_z z + b): the point's part is computed once for all shapes that share the points,
    the latent part once per shape. Points and distances are in metres; inside, points are counted from the box's centre
    in mean half sides, and distances in a tenth of one, because near the surface they are small.
    """

    centre: Tensor
    half_side: Tensor
    encoding: IdentityEncoding | FourierFeatures

    def __init__(self, settings: ModelSettings, lower: Float32[Tensor, "3"], upper: Float32[Tensor, "3"]) -> None:
        super().__init__()
        self.register_buffer("centre", (lower + upper) / 2)
        self.register_buffer("half_side", (upper - lower).mean() / 2)
        self.encoding = encoding_of(settings.encoding, settings.frequencies, settings.frequency_scale)
        first, *others = settings.decoder_widths
        self.from_point = nn.Linear(self.encoding.features, first, bias=False)
        self.from_latent = nn.Linear(settings.latent, first)
        self.activation = ACTIVATION_MODULES[settings.activation]()
        self.layers = mlp([first, *others, 1], settings.activation)

    def forward(
        self, latents: Float[Tensor, "frames latent"], points: Float32[Tensor, "points 3"] | Float32[Tensor, "frames points 3"]
    ) -> Float32[Tensor, "frames points"]:
        """Signed distances (m) of every shape at points that all share, or at points of its own."""
        return self.from_encoded(latents, self.encoded(points))

    def encoded(self, points: Float32[Tensor, "*batch 3"]) -> Float[Tensor, "*batch width"]:
        """The points' part of the first layer, W_x enc(x), the same for every shape."""
        local = (points - self.centre) / self.half_side
        if isinstance(self.encoding, FourierFeatures):
            return self.from_point(self.encoding(local))
        with torch.autocast(points.device.type, enabled=False):  # bf16 coordinates would move a point by up to a fifth of a millimetre
            return self.from_point(local)

    def from_encoded(self, latents: Float[Tensor, "frames latent"], encoded: Float[Tensor, "*batch width"]) -> Float32[Tensor, "frames points"]:
        """The rest of the network, from what `encoded` gives."""
        hidden = self.activation(encoded + self.from_latent(latents)[:, None, :])
        return self.layers(hidden).squeeze(-1).float() * (OUTPUT_UNIT * self.half_side)

    @property
    def parameter_count(self) -> int:
        """Weights, biases and the fixed frequencies: what must be stored to answer a query, the latents apart."""
        fixed = self.encoding.frequencies.numel() if isinstance(self.encoding, FourierFeatures) else 0
        return sum(weights.numel() for weights in self.parameters()) + fixed
