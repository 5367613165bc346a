"""The SDF Calculator: a latent vector and a point in, the signed distance out (paper section 4, S(z_i, X) = d)."""

import torch
from jaxtyping import Float, Float32
from torch import Tensor, nn

from sdfnet.models.encodings import Encoding, FourierFeatures, IdentityEncoding, encoding_of
from sdfnet.models.mlp import ACTIVATION_MODULES, mlp
from sdfnet.models.modulation import modulated
from sdfnet.models.settings import ModelSettings
from sdfnet.models.siren import initialise_siren
from sdfnet.models.storage import stored_bytes

CHUNK = 16_384  # points at once whose activations stay in the cache
OUTPUT_UNIT = 0.1  # of the mean half side: 1 cm on the bunny


class SdfCalculator(nn.Module):
    """An MLP on the concatenation of latent vector and encoded point, written without the concatenation.

    The first layer is W_x enc(x) + (W_z z + b): the point's part is computed once for all shapes that share the points,
    the latent part once per shape. With `conditioning: modulated` the latent scales and shifts every hidden layer instead.
    Points and distances are in metres; inside, points are counted from the box's centre in mean half sides, and
    distances in a tenth of one, because near the surface they are small.
    """

    centre: Tensor
    half_side: Tensor
    encoding: Encoding

    def __init__(self, settings: ModelSettings, lower: Float32[Tensor, "3"], upper: Float32[Tensor, "3"]) -> None:
        super().__init__()
        self.register_buffer("centre", (lower + upper) / 2)
        self.register_buffer("half_side", (upper - lower).mean() / 2)
        self.encoding = encoding_of(settings, (upper - lower) / 2 / self.half_side)
        self.is_modulated = settings.conditioning == "modulated"
        widths = settings.decoder_widths
        self.from_point = nn.Linear(self.encoding.features, widths[0], bias=False)
        self.from_latent = nn.Linear(settings.latent, 2 * sum(widths) if self.is_modulated else widths[0])
        self.activation = ACTIVATION_MODULES[settings.activation]()
        self.layers = mlp([*widths, 1], settings.activation)
        if settings.activation == "siren":
            *hidden, last = self._linear_layers
            # What the latent gives is added to the first layer; as scales and shifts of all layers it has to begin small.
            initialise_siren(self.from_point, hidden if self.is_modulated else [self.from_latent, *hidden], last, settings.omega)

    def forward(
        self, latents: Float[Tensor, "frames latent"], points: Float32[Tensor, "points 3"] | Float32[Tensor, "frames points 3"]
    ) -> Float32[Tensor, "frames points"]:
        """Signed distances (m) of every shape at points that all share, or at points of its own."""
        return self.from_encoded(latents, self.encoded(points))

    @torch.no_grad()
    def distances(self, latent: Float[Tensor, " latent"], points: Float32[Tensor, "points 3"]) -> Float32[Tensor, " points"]:
        """Signed distances (m) of one shape at any number of points, without gradients, a cacheful of points at a time."""
        return torch.cat([self(latent[None], chunk)[0] for chunk in points.split(CHUNK)])

    def encoded(self, points: Float32[Tensor, "*batch 3"]) -> Float[Tensor, "*batch width"]:
        """The points' part of the first layer, W_x enc(x), the same for every shape."""
        local = (points - self.centre) / self.half_side
        if not isinstance(self.encoding, IdentityEncoding):
            return self.from_point(self.encoding(local))
        with torch.autocast(points.device.type, enabled=False):  # bf16 coordinates would move a point by up to a fifth of a millimetre
            return self.from_point(local)

    def from_encoded(self, latents: Float[Tensor, "frames latent"], encoded: Float[Tensor, "*batch width"]) -> Float32[Tensor, "frames points"]:
        """The rest of the network, from what `encoded` gives."""
        return self.from_both(self.from_latent(latents)[:, None, :], encoded)

    def from_both(
        self, from_latent: Float[Tensor, "frames 1 features"], encoded: Float[Tensor, "*batch width"], in_place: bool = False
    ) -> Float32[Tensor, "frames points"]:
        """The rest of the network, from what its two linear maps give of latents and points; `encoded` may be overwritten with `in_place`."""
        if self.is_modulated:
            outputs = modulated(encoded, from_latent, self._linear_layers, self.activation)
        else:
            outputs = self.layers(self.activation(encoded.add_(from_latent) if in_place else encoded + from_latent))
        return outputs.squeeze(-1).float() * (OUTPUT_UNIT * self.half_side)

    def gradients(
        self, latents: Float[Tensor, "frames latent"], points: Float32[Tensor, "points 3"] | Float32[Tensor, "frames points 3"]
    ) -> Float32[Tensor, "frames points 3"]:
        """The gradient (without unit) of every shape's distance by the point, itself with a gradient; in float32 under autocast too.

        Shared points are encoded once a shape here, so it costs several times a step of the same points without it.
        """
        with torch.autocast(points.device.type, enabled=False), torch.enable_grad():
            own = points.detach().expand(len(latents), -1, 3).clone().requires_grad_()
            (gradients,) = torch.autograd.grad(self(latents.float(), own).sum(), own, create_graph=True)
        return gradients

    @property
    def parameter_count(self) -> int:
        """Weights, biases, learned grids and the fixed frequencies: what must be stored to answer a query, the latents apart."""
        return sum(rows.numel() for rows, _ in self.stored_rows("float32"))

    def stored_bytes(self, storage: str) -> int:
        """Bytes of all that `parameter_count` counts, stored that way."""
        return sum(stored_bytes(len(rows), rows.shape[1], kept_as) for rows, kept_as in self.stored_rows(storage))

    def stored_rows(self, storage: str) -> list[tuple[Float[Tensor, "rows columns"], str]]:
        """All that is counted, as tables with a row for each scale of int8, and how each is stored when the networks are as `storage`.

        Frequencies always stay in float32, and biases beside int8 weights. The first layer's weights have a row for each feature of
        the point: those of slow features are ten times as large as those of fast ones, and a scale for each output would round the fast ones away.
        """
        tables = []
        for name, weights in self.named_parameters():
            is_kept = storage == "int8" and name.endswith("bias")
            rows = weights.T if weights is self.from_point.weight else weights if weights.ndim == 2 else weights[None]
            tables.append((rows, "float32" if is_kept else storage))
        if isinstance(self.encoding, FourierFeatures):
            tables.append((self.encoding.frequencies, "float32"))
        return tables

    @property
    def _linear_layers(self) -> list[nn.Linear]:
        return [layer for layer in self.layers if isinstance(layer, nn.Linear)]
