"""The first weights that make a sine network learn (Sitzmann et al. 2020)."""

import math
from collections.abc import Iterable

import torch
from torch import nn


@torch.no_grad()
def initialise_siren(first: nn.Linear, hidden: Iterable[nn.Linear], last: nn.Linear, omega: float) -> None:
    """The network of sines sin(omega (W x + b)) that their section 3.2 begins with, its omega multiplied into W and b.

    Uniform within omega / n in the first layer, within sqrt(6 / n) in those behind it, and within sqrt(6 / n) / omega in
    the last, which has no sine; n is the number of a layer's inputs. What enters every hidden sine then has mean 0 and a
    deviation of about 1, whatever the depth (theorem 1.8 there). Biases are as PyTorch draws them, times omega: they only
    turn the phase. With omega left outside, every step would turn the phases omega times as far as it changes the
    weights, so that rates would have to be omega times as low as those of other networks.
    """
    first.weight.uniform_(-omega / first.in_features, omega / first.in_features)
    for layer in hidden:
        bound = math.sqrt(6 / layer.in_features)
        layer.weight.uniform_(-bound, bound)
        layer.bias.mul_(omega)
    bound = math.sqrt(6 / last.in_features) / omega
    last.weight.uniform_(-bound, bound)
