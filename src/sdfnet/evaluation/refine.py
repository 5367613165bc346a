"""Vertices of a marched surface, moved to where the field itself is zero and not its interpolation along the grid's edges."""

from collections.abc import Callable

import torch
from jaxtyping import Float32
from torch import Tensor

from sdfnet.geometry.surface import Surface


def refined_surface(surface: Surface, field: Callable[[Float32[Tensor, "points 3"]], Float32[Tensor, " points"]], longest: float, steps: int) -> Surface:
    """Newton steps x - f(x) g / |g|^2 along the gradient g of the field, for every vertex x, none longer than `longest` (m); the faces stay.

    `longest` bounds what a step can do where the gradient nearly vanishes. A vertex whose gradient is zero stays. Triangles
    much smaller than a step may turn over.
    """
    vertices = torch.from_numpy(surface.vertices)
    for _ in range(steps):
        points = vertices.float().requires_grad_()
        with torch.enable_grad():
            values = field(points)
            (gradients,) = torch.autograd.grad(values.sum(), points)
        step = -values.detach()[:, None] * gradients / gradients.square().sum(dim=1, keepdim=True).clamp_min(torch.finfo(torch.float32).tiny)
        too_long = (step.norm(dim=1, keepdim=True) / longest).clamp_min(1.0)
        vertices = vertices + (step / too_long).double()
    return Surface(vertices.numpy(), surface.faces)
