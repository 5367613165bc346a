"""Sine networks with the frequency and the first weights that make them learn (Sitzmann et al. 2020)."""

import math
from collections.abc import Iterable

import torch
from jaxtyping import Float
from torch import Tensor, nn

SIREN_OMEGA = 30.0  # section 3.2 there


class Siren(nn.Module):
    """sin(omega x). Of use only with `initialise_siren`; for coordinates as they are, not for a point that is encoded already."""

    def __init__(self, omega: float = SIREN_OMEGA) -> None:
        super().__init__()
        self.omega = omega

    def forward(self, values: Float[Tensor, "*batch features"]) -> Float[Tensor, "*batch features"]:
        """Apply the sine."""
        return torch.sin(self.omega * values)


@torch.no_grad()
def initialise_siren(first: nn.Linear, others: Iterable[nn.Linear], omega: float) -> None:
    """Weights uniform within 1 / n in the first layer and within sqrt(6 / n) / omega in all others, n the layer's inputs.

    Behind every hidden layer omega W x then has mean 0 and a deviation of about 1, whatever the depth (theorem 1.8 there). Biases
    stay as PyTorch draws them, as in the authors' code: they only turn the phase.
    """
    first.weight.uniform_(-1 / first.in_features, 1 / first.in_features)
    for layer in others:
        bound = math.sqrt(6 / layer.in_features) / omega
        layer.weight.uniform_(-bound, bound)
