"""What every combination of encoding, activation, conditioning and latents must keep."""

from dataclasses import asdict
from itertools import product
from pathlib import Path

import pytest
import torch

from sdfnet.models.networks import CHECKPOINT_PREFIX, RECORD, Networks, load_networks
from sdfnet.models.settings import ACTIVATIONS, CONDITIONINGS, ENCODINGS, LATENTS, ModelSettings

SHAPES = 0.05 * torch.randn(5, 7, 3, generator=torch.Generator().manual_seed(1))
LOWER, UPPER = torch.tensor([-0.1, -0.2, 0.0]), torch.tensor([0.3, 0.2, 0.5])
BOX = 4  # numbers that say where the box is: centre and half side
KINDS = list(product(ENCODINGS, ACTIVATIONS, CONDITIONINGS, LATENTS))

pytestmark = pytest.mark.parametrize("kind", KINDS, ids="-".join)


def networks_of(kind: tuple[str, str, str, str]) -> Networks:
    encoding, activation, conditioning, latents = kind
    settings = ModelSettings(
        8, 3, latent=3, encoding=encoding, frequencies=4, include_input=True, activation=activation, conditioning=conditioning, latents=latents,
        grid_levels=2, grid_resolution=2, grid_table_size=40,
    )  # fmt: skip
    return Networks(settings, SHAPES, LOWER, UPPER)


def test_shapes_and_gradients_are_right_and_finite(kind: tuple[str, str, str, str]) -> None:
    networks, points = networks_of(kind), LOWER + torch.rand(20, 3) * (UPPER - LOWER)
    latents = networks.encoder(SHAPES)
    assert latents.shape == (5, 3)
    shared = networks.decoder(latents, points)
    assert shared.shape == (5, 20)
    # the same sums in another order: outputs are below one metre, float32 rounds at 6e-8
    torch.testing.assert_close(networks.decoder(latents, points.expand(5, 20, 3).clone()), shared, rtol=0, atol=1e-6)
    slopes = networks.decoder.gradients(latents, points)
    assert slopes.shape == (5, 20, 3)
    (shared.square().sum() + slopes.square().sum()).backward()
    for name, weights in networks.named_parameters():
        if weights.requires_grad:
            assert weights.grad is not None, name
            assert weights.grad.isfinite().all(), name


def test_networks_read_back_from_a_checkpoint_answer_bit_for_bit(kind: tuple[str, str, str, str], tmp_path: Path) -> None:
    networks, points = networks_of(kind), torch.rand(20, 3)
    weights = {CHECKPOINT_PREFIX + name: values for name, values in networks.state_dict().items()}
    torch.save({"state_dict": weights, RECORD: {"model": asdict(networks.settings)}}, tmp_path / "last.ckpt")
    assert torch.equal(load_networks(tmp_path / "last.ckpt")(SHAPES, points), networks(SHAPES, points))


def test_the_parameters_counted_are_the_numbers_stored(kind: tuple[str, str, str, str]) -> None:
    networks = networks_of(kind)
    stored = {name: values.numel() for name, values in networks.decoder.state_dict().items() if name != "encoding.extent"}
    assert networks.decoder.parameter_count == sum(stored.values()) - BOX
    assert networks.sizes(101)["query_bytes"] == 4 * (networks.decoder.parameter_count + 101 * 3)
    coded = {"encoder": 21 * 8 + 8 + 8 * 8 + 8 + 8 * 4 + 4 + 4 * 3 + 3, "pod": 21 * 3, "learned": 5 * 3}
    assert networks.sizes(101)["encoder_parameters"] == coded[kind[3]]
