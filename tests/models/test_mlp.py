"""Layers and activations of the networks, and the settings that size them."""

import pytest
import torch
from torch import nn

from sdfnet.errors import ConfigurationError
from sdfnet.models.mlp import ACTIVATION_MODULES, Sine, mlp
from sdfnet.models.settings import ACTIVATIONS, ModelSettings, hidden_widths


def test_activations_stand_between_the_layers_and_not_after_the_last() -> None:
    layers = mlp([5, 4, 3, 1], "relu")
    assert [type(layer) for layer in layers] == [nn.Linear, nn.ReLU, nn.Linear, nn.ReLU, nn.Linear]
    assert [(layer.in_features, layer.out_features) for layer in layers if isinstance(layer, nn.Linear)] == [(5, 4), (4, 3), (3, 1)]


@pytest.mark.parametrize("name", ACTIVATIONS)
def test_every_activation_in_the_settings_exists(name: str) -> None:
    assert mlp([3, 4, 1], name)(torch.rand(2, 3)).shape == (2, 1)
    assert set(ACTIVATION_MODULES) == set(ACTIVATIONS)


def test_the_sine_is_a_sine() -> None:
    values = torch.linspace(-3, 3, 13)[:, None]
    assert torch.equal(Sine()(values), torch.sin(values))


def test_the_defaults_are_the_papers_widths() -> None:
    settings = ModelSettings()
    assert settings.decoder_widths == settings.encoder_widths == [256, 256, 128]
    assert settings.latent == 128


def test_only_three_or_more_layers_taper() -> None:
    assert hidden_widths(64, 2, taper=True) == [64, 64]
    assert hidden_widths(64, 4, taper=True) == [64, 64, 64, 32]
    assert hidden_widths(64, 3, taper=False) == [64, 64, 64]
    assert hidden_widths(1, 3, taper=True) == [1, 1, 1]


def test_the_encoder_can_have_a_size_of_its_own() -> None:
    settings = ModelSettings(width=64, depth=2, encoder_width=16, encoder_depth=1)
    assert settings.encoder_widths == [16]
    assert settings.decoder_widths == [64, 64]


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"width": 0}, "model.width must be at least 1, found 0"),
        ({"latent": -1}, "model.latent must be at least 1, found -1"),
        ({"encoder_width": 0}, "model.encoder_width must be at least 1, found 0"),
        ({"encoder_depth": 0}, "model.encoder_depth must be at least 1, found 0"),
        ({"encoding": "wavelet"}, "model.encoding must be one of none, fourier, hash_grid, dense_grid; found 'wavelet'"),
        ({"activation": "step"}, "model.activation must be one of relu, gelu, silu, sine, siren; found 'step'"),
        ({"conditioning": "attention"}, "model.conditioning must be one of first_layer, modulated; found 'attention'"),
        ({"latents": "none"}, "model.latents must be one of encoder, pod, learned; found 'none'"),
        ({"grid_levels": 0}, "model.grid_levels must be at least 1, found 0"),
        ({"grid_growth": 0.5}, "model.grid_growth must be at least 1 and finite, found 0.5"),
        ({"omega": 0.0}, "model.omega must be positive and finite, found 0.0"),
        ({"frequency_scale": 0.0}, "model.frequency_scale must be positive and finite, found 0.0"),
    ],
)
def test_a_size_that_cannot_be_is_refused_by_name(wrong: dict[str, int | float | str], message: str) -> None:
    with pytest.raises(ConfigurationError, match=message):
        ModelSettings(**wrong)  # type: ignore[arg-type]
