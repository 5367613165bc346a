"""A latent vector that scales and shifts every hidden layer (FiLM, Perez et al. 2018), not only the first."""

from collections.abc import Sequence

from jaxtyping import Float
from torch import Tensor, nn


def modulated(
    encoded: Float[Tensor, "*batch width"], modulation: Float[Tensor, "frames 1 modulation"], layers: Sequence[nn.Linear], activation: nn.Module
) -> Float[Tensor, "frames points 1"]:
    """h_0 = a((1 + s_0) e + t_0), h_k = a((1 + s_k) (W_k h_(k-1) + b_k) + t_k), and W h + b of the last layer.

    `modulation` holds all scales s, then all shifts t, of every shape: twice the sum of the hidden widths. It is computed
    once a shape, but every layer costs a product and a sum more at every point of every shape.
    """
    *hidden_layers, last = layers
    widths = [layer.in_features for layer in layers]
    scales, shifts = modulation.chunk(2, dim=-1)
    hidden: Tensor = encoded
    for layer, scale, shift in zip([nn.Identity(), *hidden_layers], scales.split(widths, dim=-1), shifts.split(widths, dim=-1), strict=True):
        hidden = activation((1 + scale) * layer(hidden) + shift)
    result: Tensor = last(hidden)
    return result
