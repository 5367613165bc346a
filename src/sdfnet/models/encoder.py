"""The Mesh Encoder: the surface vertices of a shape in, its latent vector out (paper section 4, M(P_i) = z_i)."""

import torch
from jaxtyping import Float, Float32
from torch import Tensor, nn

from sdfnet.models.mlp import mlp


class MeshEncoder(nn.Module):
    """An MLP over the flattened vertex positions of one topology; its input is as wide as the mesh, 3 x vertices.

    Positions enter as (P - mean shape) / scale, both taken from the training shapes and saved with the weights: the
    shapes differ by millimetres on a solid of decimetres, and the difference is what is to be encoded. The scale is the
    root mean square of |P - mean shape| over the shapes, all N = 3 x vertices coordinates together: a step of Adam, which
    moves every weight by the rate, then changes what the first layer gives by up to rate x sqrt(N), not rate x N, which at
    the paper's rate is a hundred on the bunny.
    """

    mean_shape: Tensor
    scale: Tensor

    def __init__(self, shapes: Float32[Tensor, "frames vertices 3"], hidden: list[int], latent: int) -> None:
        super().__init__()
        mean_shape = shapes.mean(dim=0)
        deviation = (shapes - mean_shape).square().sum(dim=(1, 2)).mean().sqrt()
        self.register_buffer("mean_shape", mean_shape)
        self.register_buffer("scale", torch.where(deviation > 0, deviation, torch.ones_like(deviation)))
        self.layers = mlp([3 * shapes.shape[1], *hidden, latent], "relu")

    def forward(self, shapes: Float32[Tensor, "frames vertices 3"]) -> Float[Tensor, "frames latent"]:
        """Latent vectors of shapes given by their vertices (m)."""
        with torch.autocast(shapes.device.type, enabled=False):  # so wide an input loses more to bf16 than its speed is worth
            return self.layers(((shapes - self.mean_shape) / self.scale).flatten(1))
