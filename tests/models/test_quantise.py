"""Trained networks in fewer bytes."""

import pytest
import torch

from sdfnet.errors import ConfigurationError, TrainingError
from sdfnet.models.networks import Networks
from sdfnet.models.quantise import quantised
from sdfnet.models.settings import ModelSettings
from sdfnet.models.storage import STORAGES, as_stored

SHAPES = 0.05 * torch.randn(5, 7, 3, generator=torch.Generator().manual_seed(4))
WEIGHTS, BIASES, FREQUENCIES, ROWS = 12 * 8 + 4 * 8 + 8 * 8 + 8, 8 + 8 + 1, 18, 12 + 8 + 8 + 1
BYTES = {
    "float32": 4 * (WEIGHTS + BIASES + FREQUENCIES + 101 * 4),
    "fp16": 2 * (WEIGHTS + BIASES + 101 * 4) + 4 * FREQUENCIES,
    "int8": WEIGHTS + 4 * ROWS + 4 * (BIASES + FREQUENCIES) + 101 * (4 + 4),
}


@pytest.fixture
def networks() -> Networks:
    return Networks(ModelSettings(8, 2, latent=4, encoding="fourier", frequencies=6), SHAPES, torch.zeros(3), torch.ones(3))


def test_int8_is_wrong_by_half_a_step_of_its_row_at_most_and_keeps_the_largest_and_zero() -> None:
    rows = torch.randn(6, 50) * torch.tensor([1e-6, 1e-3, 1.0, 30.0, 1e4, 0.0])[:, None]
    rows[:, 7] = 0
    stored = as_stored(rows, "int8")
    largest = rows.abs().amax(dim=1, keepdim=True)
    assert ((stored - rows).abs() <= largest / 127 / 2 * 1.00001).all()  # float32 rounds the quotient and the product
    assert float((stored - rows).abs().max()) > 0
    torch.testing.assert_close(stored.abs().amax(dim=1, keepdim=True), largest, rtol=1e-6, atol=0)
    assert (stored[:, 7] == 0).all()
    assert all(len(row.unique()) <= 255 for row in stored)


def test_fp16_keeps_eleven_bits_and_refuses_what_it_cannot_hold() -> None:
    rows = torch.randn(4, 100)
    torch.testing.assert_close(as_stored(rows, "fp16"), rows, rtol=2**-11, atol=2**-25)  # half a unit, and half the smallest number
    with pytest.raises(TrainingError, match=r"fp16 holds numbers up to 65504, found 70000; store the networks as int8 or float32"):
        as_stored(torch.tensor([[7e4]]), "fp16")


@pytest.mark.parametrize("storage", STORAGES)
def test_bytes_are_those_of_the_numbers_and_scales_as_stored(networks: Networks, storage: str) -> None:
    assert quantised(networks, storage).sizes(101) == networks.sizes(101) | {"query_bytes": BYTES[storage]}


@torch.no_grad()
@pytest.mark.parametrize(("storage", "wrong"), [("float32", 0.0), ("fp16", 1e-4), ("int8", 1e-2)])
def test_quantised_networks_answer_nearly_the_same_and_the_first_are_untouched(networks: Networks, storage: str, wrong: float) -> None:
    points = torch.rand(40, 3)
    before, weights = networks.decoder(networks.latents(SHAPES), points), {name: values.clone() for name, values in networks.state_dict().items()}
    rounded = quantised(networks, storage)
    after = rounded.decoder(rounded.latents(SHAPES), points)
    # outputs are below 0.05 m; three layers each lose 2^-11 or a 254th of them
    assert float((after - before).abs().max()) <= 0.05 * 3 * wrong * 2
    assert torch.equal(after, before) == (storage == "float32")
    assert all(torch.equal(values, weights[name]) for name, values in networks.state_dict().items())


@pytest.mark.parametrize("encoding", ["fourier", "hash_grid"])
def test_int8_rounds_weights_grids_and_latents_but_no_bias_and_no_frequency(encoding: str) -> None:
    networks = Networks(ModelSettings(8, 2, latent=4, encoding=encoding, grid_levels=2), SHAPES, torch.zeros(3), torch.ones(3))
    rounded = quantised(networks, "int8")
    same = {name for name, values in rounded.decoder.state_dict().items() if torch.equal(values, networks.decoder.state_dict()[name])}
    box = {"centre", "half_side"}
    assert same - box == {"from_latent.bias", "layers.0.bias", "layers.2.bias", "encoding.frequencies" if encoding == "fourier" else "encoding.extent"}
    assert not torch.equal(rounded.latents(SHAPES), networks.latents(SHAPES))
    assert torch.equal(rounded.latents(SHAPES), as_stored(networks.latents(SHAPES), "int8"))


@torch.no_grad()
def test_int8_keeps_features_whose_weights_are_small_beside_those_of_others(networks: Networks) -> None:
    weights = networks.decoder.from_point.weight
    weights[:, 0] *= 1000
    rounded = quantised(networks, "int8").decoder.from_point.weight
    torch.testing.assert_close(rounded[:, 1:], weights[:, 1:], rtol=0, atol=float(weights[:, 1:].abs().max()) / 254)


def test_what_cannot_be_quantised_is_refused(networks: Networks) -> None:
    with pytest.raises(ConfigurationError, match=r"the storage must be one of float32, fp16, int8; found 'int4'"):
        quantised(networks, "int4")
    with pytest.raises(ConfigurationError, match=r"networks to be quantised must be in float32, found fp16; quantise those of the checkpoint"):
        quantised(quantised(networks, "fp16"), "int8")
