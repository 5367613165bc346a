"""Latents without an encoder: a free vector for each training frame (DeepSDF, Park et al. 2019)."""

import math

import torch
from jaxtyping import Float32, Int64
from torch import Tensor, nn

from sdfnet.errors import TrainingError


class LearnedLatents(nn.Module):
    """A vector for each training shape, trained with the SDF Calculator; a shape is known by a checksum of its coordinates.

    Not for shapes that were not trained on: they have no latent and are refused. Equal shapes share the first one's.
    """

    checksums: Tensor

    def __init__(self, shapes: Float32[Tensor, "frames vertices 3"], latent: int) -> None:
        super().__init__()
        self.register_buffer("checksums", checksums(shapes))
        self.vectors = nn.Parameter(torch.randn(len(shapes), latent) / math.sqrt(latent))  # of length about one, as in the authors' code

    def forward(self, shapes: Float32[Tensor, "frames vertices 3"]) -> Float32[Tensor, "frames latent"]:
        """Latent vectors of training shapes. Raises TrainingError when a shape is none of them."""
        is_same = checksums(shapes)[:, None] == self.checksums
        unknown = int((~is_same.any(dim=1)).sum())
        if unknown:
            raise TrainingError(
                f"model.latents=learned knows the {len(self.checksums)} shapes that it was trained on, found {unknown} of {len(shapes)} that are none of them; "
                "train on all frames with split=all, or choose model.latents=encoder or pod"
            )
        return self.vectors.index_select(0, is_same.int().argmax(dim=1))


def checksums(shapes: Float32[Tensor, "frames vertices 3"]) -> Int64[Tensor, " frames"]:
    """The sum of n times the n-th coordinate's bits, exact in whole numbers and so the same in any batch and on any device."""
    bits = shapes.flatten(1).contiguous().view(torch.int32).long()
    return (bits * torch.arange(1, bits.shape[1] + 1, device=bits.device)).sum(dim=1)
