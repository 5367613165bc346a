"""Multi-layer perceptrons and their activations."""

from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn


class Sine(nn.Module):
    """sin(x), for signals with derivatives; siren is this with first weights of its own (`initialise_siren`)."""

    def forward(self, values: Float[Tensor, "*batch features"]) -> Float[Tensor, "*batch features"]:
        """Apply the sine."""
        return torch.sin(values)


ACTIVATION_MODULES: dict[str, type[nn.Module]] = {"relu": nn.ReLU, "gelu": nn.GELU, "silu": nn.SiLU, "sine": Sine, "siren": Sine}


def mlp(widths: list[int], activation: str) -> nn.Sequential:
    """Linear layers from widths[0] to widths[-1] with the activation between them and none after the last (paper section 4)."""
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(widths):
        layers += [nn.Linear(inputs, outputs), ACTIVATION_MODULES[activation]()]
    return nn.Sequential(*layers[:-1])
