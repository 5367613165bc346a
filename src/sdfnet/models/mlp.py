"""Multi-layer perceptrons and their activations."""

from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor, nn

from sdfnet.models.siren import SIREN_OMEGA, Siren


class Sine(nn.Module):
    """sin(x), for signals with derivatives (Sitzmann et al. 2020, with a unit frequency)."""

    def forward(self, values: Float[Tensor, "*batch features"]) -> Float[Tensor, "*batch features"]:
        """Apply the sine."""
        return torch.sin(values)


ACTIVATION_MODULES: dict[str, type[nn.Module]] = {"relu": nn.ReLU, "gelu": nn.GELU, "silu": nn.SiLU, "sine": Sine, "siren": Siren}


def activation_of(name: str, omega: float = SIREN_OMEGA) -> nn.Module:
    """The activation by its name in the settings; only siren reads `omega`."""
    return Siren(omega) if name == "siren" else ACTIVATION_MODULES[name]()


def mlp(widths: list[int], activation: str, omega: float = SIREN_OMEGA) -> nn.Sequential:
    """Linear layers from widths[0] to widths[-1] with the activation between them and none after the last (paper section 4)."""
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(widths):
        layers += [nn.Linear(inputs, outputs), activation_of(activation, omega)]
    return nn.Sequential(*layers[:-1])
