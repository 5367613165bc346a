"""The SDF Calculator: the split first layer is the plain network on the concatenated input."""

import pytest
import torch
from torch import Tensor, nn

from sdfnet.models.decoder import OUTPUT_UNIT, SdfCalculator
from sdfnet.models.mlp import mlp
from sdfnet.models.settings import ModelSettings

LOWER, UPPER = torch.tensor([-0.1, -0.2, 0.0]), torch.tensor([0.3, 0.2, 0.5])
SMALL = ModelSettings(width=64, depth=2, taper=False, latent=32, encoding="fourier", frequencies=64)
KINDS = [
    SMALL,
    ModelSettings(),
    ModelSettings(width=16, depth=1, latent=3, activation="sine"),
    ModelSettings(width=8, depth=4, latent=5, activation="gelu"),
    ModelSettings(width=8, depth=3, latent=5, encoding="hash_grid", activation="siren"),
]


def plain_distances(decoder: SdfCalculator, settings: ModelSettings, latents: Tensor, points: Tensor) -> Tensor:
    """What the paper writes: one MLP with the decoder's weights on the concatenation of latent and encoded point, metres in and out."""
    network = mlp([settings.latent + decoder.encoding.features, *settings.decoder_widths, 1], settings.activation)
    first = network[0]
    assert isinstance(first, nn.Linear)
    with torch.no_grad():
        first.weight.copy_(torch.cat([decoder.from_latent.weight, decoder.from_point.weight], dim=1))
        first.bias.copy_(decoder.from_latent.bias)
    for own, given in zip(list(network)[2:], decoder.layers, strict=True):
        own.load_state_dict(given.state_dict())
    half_side = (UPPER - LOWER).mean() / 2
    encoded = decoder.encoding((points - (LOWER + UPPER) / 2) / half_side)
    rows = [network(torch.cat([latent.expand(len(points), -1), encoded], dim=1))[:, 0] for latent in latents]
    return torch.stack(rows) * OUTPUT_UNIT * half_side


def points_in_box(*count: int) -> Tensor:
    return LOWER + torch.rand(*count, 3) * (UPPER - LOWER)


@pytest.mark.parametrize("settings", KINDS, ids=lambda settings: f"{settings.encoding}-{settings.width}x{settings.depth}-{settings.activation}")
def test_the_split_first_layer_equals_the_plain_network_on_the_concatenated_input(settings: ModelSettings) -> None:
    decoder = SdfCalculator(settings, LOWER, UPPER)
    latents, points = torch.randn(4, settings.latent), points_in_box(30)
    # the two add the same numbers in another order; outputs are below one metre, float32 rounds at 6e-8
    torch.testing.assert_close(decoder(latents, points), plain_distances(decoder, settings, latents, points), rtol=0, atol=1e-6)


@pytest.mark.parametrize("settings", KINDS[:2], ids=["small", "paper"])
def test_shared_points_give_what_each_frames_own_copy_gives(settings: ModelSettings) -> None:
    decoder = SdfCalculator(settings, LOWER, UPPER)
    latents, points = torch.randn(3, settings.latent), points_in_box(20)
    torch.testing.assert_close(decoder(latents, points), decoder(latents, points.expand(3, 20, 3).clone()), rtol=0, atol=1e-6)


def test_points_of_its_own_belong_to_their_frame() -> None:
    decoder = SdfCalculator(SMALL, LOWER, UPPER)
    latents, points = torch.randn(3, 32), points_in_box(3, 20)
    together = decoder(latents, points)
    for frame in range(3):
        torch.testing.assert_close(together[frame], decoder(latents[frame][None], points[frame])[0], rtol=0, atol=1e-6)


def test_the_latent_part_is_computed_once_a_shape_and_the_point_part_once_a_point() -> None:
    decoder = SdfCalculator(SMALL, LOWER, UPPER)
    rows: dict[str, list[torch.Size]] = {"latent": [], "point": []}
    decoder.from_latent.register_forward_hook(lambda _, inputs, __: rows["latent"].append(inputs[0].shape))
    decoder.from_point.register_forward_hook(lambda _, inputs, __: rows["point"].append(inputs[0].shape))
    decoder(torch.randn(5, 32), points_in_box(40))
    assert rows == {"latent": [torch.Size([5, 32])], "point": [torch.Size([40, 128])]}


def test_parameters_counted_are_those_of_the_issue_and_of_the_paper() -> None:
    assert SdfCalculator(SMALL, LOWER, UPPER).parameter_count == 14_721  # the 64 x 3 fixed frequencies are among them
    assert SdfCalculator(ModelSettings(), LOWER, UPPER).parameter_count == 132_609


def test_the_papers_decoder_has_its_layers() -> None:
    decoder = SdfCalculator(ModelSettings(), LOWER, UPPER)
    assert decoder.from_latent.in_features + decoder.from_point.in_features == 128 + 3
    assert [layer.in_features for layer in decoder.layers if isinstance(layer, nn.Linear)] == [256, 256, 128]
    assert [layer.out_features for layer in decoder.layers if isinstance(layer, nn.Linear)] == [256, 128, 1]
    assert sum(isinstance(layer, nn.ReLU) for layer in (decoder.activation, *decoder.layers)) == 3


def test_a_model_ten_times_as_large_answers_ten_times_as_far() -> None:
    decoder, large = SdfCalculator(SMALL, LOWER, UPPER), SdfCalculator(SMALL, 10 * LOWER, 10 * UPPER)
    large.load_state_dict({name: values for name, values in decoder.state_dict().items() if name not in ("centre", "half_side")}, strict=False)
    latents, points = torch.randn(2, 32), points_in_box(20)
    # scaled points round differently in float32, and the highest frequencies turn 1e-7 into 1e-6 of the output
    torch.testing.assert_close(large(latents, 10 * points), 10 * decoder(latents, points), rtol=1e-4, atol=2e-5)


def test_distances_are_float32_under_autocast() -> None:
    decoder = SdfCalculator(SMALL, LOWER, UPPER)
    latents, points = torch.randn(2, 32), points_in_box(50)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        rounded = decoder(latents, points)
    assert rounded.dtype == torch.float32
    # bf16 keeps eight bits: three layers of it lose about one part in a hundred of outputs below 0.3 m
    torch.testing.assert_close(rounded, decoder(latents, points), rtol=0, atol=5e-3)


def test_a_modulated_decoder_is_the_formula_layer_by_layer() -> None:
    settings = ModelSettings(width=6, depth=3, taper=True, latent=4, activation="silu", conditioning="modulated")
    decoder = SdfCalculator(settings, LOWER, UPPER)
    latents, points = torch.randn(2, 4), points_in_box(10)
    linear = [layer for layer in decoder.layers if isinstance(layer, nn.Linear)]
    for latent, found in zip(latents, decoder(latents, points), strict=True):
        numbers = decoder.from_latent.weight @ latent + decoder.from_latent.bias
        scales, shifts = numbers[:15].split([6, 6, 3]), numbers[15:].split([6, 6, 3])
        hidden = decoder.from_point((points - (LOWER + UPPER) / 2) / ((UPPER - LOWER).mean() / 2))
        for place in range(3):
            hidden = hidden if place == 0 else linear[place - 1](hidden)
            hidden = nn.functional.silu((1 + scales[place]) * hidden + shifts[place])
        # the same sums in another order, of numbers below one
        torch.testing.assert_close(found, linear[-1](hidden)[:, 0] * OUTPUT_UNIT * (UPPER - LOWER).mean() / 2, rtol=0, atol=1e-6)


@pytest.mark.parametrize("conditioning", ["first_layer", "modulated"])
def test_gradients_are_those_of_each_shapes_own_distance_and_lead_back_to_the_weights(conditioning: str) -> None:
    settings = ModelSettings(width=8, depth=2, latent=3, encoding="fourier", frequencies=4, activation="silu", conditioning=conditioning)
    decoder = SdfCalculator(settings, LOWER, UPPER)
    latents, points = torch.randn(2, 3), points_in_box(10)
    found = decoder.gradients(latents, points)
    for frame in range(2):
        own = points.clone().requires_grad_()
        (slope,) = torch.autograd.grad(decoder(latents[frame : frame + 1], own).sum(), own)
        torch.testing.assert_close(found[frame], slope, rtol=1e-4, atol=1e-5)  # float32, in another order
    with torch.autocast("cpu", dtype=torch.bfloat16):
        under_autocast = decoder.gradients(latents.bfloat16().float(), points)
    assert torch.equal(under_autocast, decoder.gradients(latents.bfloat16().float(), points))
    found.square().sum().backward()
    assert all(weights.grad is not None and float(weights.grad.abs().max()) > 0 for name, weights in decoder.named_parameters() if "weight" in name)
