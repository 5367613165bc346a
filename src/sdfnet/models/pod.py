"""Latents without training: the coefficients of a shape in the modes in which the training shapes differ most."""

import math

import torch
from jaxtyping import Float32
from torch import Tensor, nn

from sdfnet.errors import ConfigurationError


class PodLatents(nn.Module):
    """z_k = m_k . (P - mean shape) / s_k: proper orthogonal decomposition, whitened to deviation one over the training shapes.

    m_k are the right singular vectors of the centred shapes, largest first, s_k the deviation of the training shapes along
    them. Any shape of the same topology has a latent, by projection; what it has outside the modes is lost. Not for
    families that few modes do not span, such as solids that turn. Nothing here is trained.
    """

    mean_shape: Tensor
    deviations: Tensor

    def __init__(self, shapes: Float32[Tensor, "frames vertices 3"], latent: int) -> None:
        """Raises ConfigurationError when the shapes have fewer modes than `latent` above the rounding of float32."""
        super().__init__()
        flat = shapes.flatten(1).double()
        _, values, modes = torch.linalg.svd(flat - flat.mean(dim=0), full_matrices=False)
        deviations = values / math.sqrt(len(flat))
        rounding = torch.finfo(torch.float32).eps * flat.abs().max() * (1 + math.sqrt(flat.shape[1] / len(flat)))  # of a random matrix of that size
        count = int((deviations >= rounding).sum())  # not above: the blank shapes with which a checkpoint's networks are made pass
        if count < latent:
            raise ConfigurationError(f"model.latents=pod needs model.latent={latent} modes, found {count} in {len(shapes)} training shapes; lower model.latent")
        modes, deviations = modes[:latent], deviations[:latent].float()
        largest = modes.gather(1, modes.abs().argmax(dim=1, keepdim=True))  # a mode's sign is arbitrary: this component shall be positive
        self.modes = nn.Parameter((modes * largest.sign()).float(), requires_grad=False)  # counted and saved as weights, never trained
        self.register_buffer("mean_shape", shapes.double().mean(dim=0).float())
        self.register_buffer("deviations", torch.where(deviations > 0, deviations, torch.ones_like(deviations)))

    def forward(self, shapes: Float32[Tensor, "frames vertices 3"]) -> Float32[Tensor, "frames latent"]:
        """Latent vectors of shapes given by their vertices (m)."""
        with torch.autocast(shapes.device.type, enabled=False):
            return (shapes - self.mean_shape).flatten(1) @ self.modes.T / self.deviations
