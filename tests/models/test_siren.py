"""Sine networks begin as Sitzmann et al. say they must."""

import math

import pytest
import torch
from torch import nn

from sdfnet.models.decoder import SdfCalculator
from sdfnet.models.mlp import mlp
from sdfnet.models.settings import ModelSettings
from sdfnet.models.siren import initialise_siren


@torch.no_grad()
@pytest.mark.parametrize("omega", [5.0, 30.0])
def test_every_hidden_layer_begins_with_deviation_one_before_the_sine_and_variance_one_half_behind_it(omega: float) -> None:
    first, layers = nn.Linear(3, 512), mlp([512, 512, 512, 512, 1], "siren")
    linear = [layer for layer in layers if isinstance(layer, nn.Linear)]
    initialise_siren(first, linear[:-1], linear[-1], omega)
    behind = torch.sin(first(2 * torch.rand(500, 3) - 1))
    for layer in linear[:-1]:
        before = behind @ layer.weight.T
        # 512 rows of 512 uniform numbers: the deviation over them all scatters by about 1 / sqrt(512), 4 %
        assert float(before.std()) == pytest.approx(1, abs=0.12)
        behind = torch.sin(layer(behind))
        # the paper counts on 1/2, that of an even phase; normal phases s without biases settle at s^2 = 1 - exp(-2 s^2), half of it 0.40
        assert float(behind.var()) == pytest.approx(0.5, abs=0.11)


def test_the_decoders_layers_begin_within_the_bounds_of_the_paper() -> None:
    settings = ModelSettings(width=64, depth=3, taper=False, latent=16, activation="siren", omega=20.0)
    decoder = SdfCalculator(settings, torch.zeros(3), torch.ones(3))
    *hidden, last = [layer for layer in (decoder.from_latent, *decoder.layers) if isinstance(layer, nn.Linear)]
    assert len(hidden) == 3
    bounds = [(decoder.from_point, 20 / 3), (last, math.sqrt(6 / 64) / 20), *[(layer, math.sqrt(6 / layer.in_features)) for layer in hidden]]
    for layer, bound in bounds:
        # the largest of 64 or more uniform numbers lies within a fifth of the bound but for a chance of 1e-6
        assert 0.8 * bound < float(layer.weight.detach().abs().max()) <= bound
    assert 0.8 * 20 / math.sqrt(16) < float(decoder.from_latent.bias.detach().abs().max()) <= 20 / math.sqrt(16)


@torch.no_grad()
def test_a_modulated_decoder_begins_with_every_layer_nearly_as_it_is_without_its_latent() -> None:
    settings = ModelSettings(width=64, depth=3, taper=False, latent=16, activation="siren", omega=20.0, conditioning="modulated")
    decoder = SdfCalculator(settings, torch.zeros(3), torch.ones(3))
    scales, _ = decoder.from_latent(torch.nn.functional.normalize(torch.randn(8, 16))).chunk(2, dim=-1)
    assert float(scales.abs().max()) < 1  # no layer starts with its sign turned
