"""Where the latent vector of a shape comes from."""

from collections.abc import Mapping

import torch
from jaxtyping import Float32
from torch import Tensor

from sdfnet.models.encoder import MeshEncoder
from sdfnet.models.learned_latents import LearnedLatents
from sdfnet.models.pod import PodLatents
from sdfnet.models.settings import ModelSettings

LatentSource = MeshEncoder | PodLatents | LearnedLatents


def latent_source_of(settings: ModelSettings, shapes: Float32[Tensor, "frames vertices 3"]) -> LatentSource:
    """What the settings name, for these training shapes (m)."""
    if settings.latents == "pod":
        return PodLatents(shapes, settings.latent)
    if settings.latents == "learned":
        return LearnedLatents(shapes, settings.latent)
    return MeshEncoder(shapes, settings.encoder_widths, settings.latent)


def blank_shapes(settings: ModelSettings, weights: Mapping[str, Tensor]) -> Float32[Tensor, "frames vertices 3"]:
    """Shapes of zeros, as many and as large as a latent source with these saved weights can be made of before it reads them."""
    if settings.latents == "learned":
        return torch.zeros(len(weights["encoder.vectors"]), 1, 3)
    return torch.zeros(settings.latent, *weights["encoder.mean_shape"].shape)
