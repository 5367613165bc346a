"""Both networks together, and how they are read back from a checkpoint."""

from dataclasses import asdict
from pathlib import Path
from typing import Any

import pytest
import torch

from sdfnet.errors import TrainingError
from sdfnet.models.networks import CHECKPOINT_PREFIX, RECORD, Networks, load_networks, read_checkpoint
from sdfnet.models.settings import ModelSettings

SETTINGS = ModelSettings(width=8, depth=2, taper=False, latent=4, encoding="fourier", frequencies=6, encoder_width=5)
SHAPES = torch.linspace(-0.1, 0.1, 3 * 7 * 3).reshape(3, 7, 3) ** 2


@pytest.fixture
def networks() -> Networks:
    return Networks(SETTINGS, SHAPES, torch.zeros(3), torch.ones(3))


def contents_of(networks: Networks) -> dict[str, Any]:
    """The part of a training checkpoint that holds the networks."""
    weights = {CHECKPOINT_PREFIX + name: values for name, values in networks.state_dict().items()}
    return {"state_dict": weights, RECORD: {"model": asdict(networks.settings)}}


def test_distances_are_those_of_the_decoder_at_the_encoders_latents(networks: Networks) -> None:
    points = torch.rand(10, 3)
    latents = networks.latents(SHAPES)
    assert not latents.requires_grad
    assert torch.equal(networks(SHAPES, points), networks.decoder(latents, points))


def test_sizes_count_everything_that_answers_a_query(networks: Networks) -> None:
    decoder = 12 * 8 + 4 * 8 + 8 + 8 * 8 + 8 + 8 + 1 + 3 * 6
    encoder = 21 * 5 + 5 + 5 * 5 + 5 + 5 * 4 + 4
    assert networks.sizes(frames=101) == {"decoder_parameters": decoder, "encoder_parameters": encoder, "query_bytes": 4 * (decoder + 101 * 4)}


def test_networks_read_back_answer_the_same(networks: Networks, tmp_path: Path) -> None:
    torch.save(contents_of(networks), tmp_path / "last.ckpt")
    found = load_networks(tmp_path / "last.ckpt")
    points = torch.rand(10, 3)
    assert found.settings == SETTINGS
    assert torch.equal(found(SHAPES, points), networks(SHAPES, points))


def test_a_missing_checkpoint_is_named(tmp_path: Path) -> None:
    with pytest.raises(TrainingError, match=r"no checkpoint at '.*nowhere.ckpt'; give checkpoint=outputs"):
        read_checkpoint(tmp_path / "nowhere.ckpt")


def test_a_truncated_checkpoint_is_refused(networks: Networks, tmp_path: Path) -> None:
    path = tmp_path / "last.ckpt"
    torch.save(contents_of(networks), path)
    path.write_bytes(path.read_bytes()[:1000])
    with pytest.raises(TrainingError, match="is not a whole checkpoint of sdfnet"):
        read_checkpoint(path)


@pytest.mark.parametrize("foreign", [{"state_dict": {}}, [1, 2]], ids=["no record", "no dictionary"])
def test_a_checkpoint_of_another_program_is_refused(foreign: object, tmp_path: Path) -> None:
    torch.save(foreign, tmp_path / "last.ckpt")
    with pytest.raises(TrainingError, match=r"is a checkpoint of another program, expected one written by train.py"):
        read_checkpoint(tmp_path / "last.ckpt")


def test_weights_that_are_not_of_the_model_named_beside_them_are_refused(networks: Networks, tmp_path: Path) -> None:
    contents = contents_of(networks)
    contents[RECORD]["model"]["width"] = 9
    torch.save(contents, tmp_path / "last.ckpt")
    with pytest.raises(TrainingError, match="does not fit the model that it names"):
        load_networks(tmp_path / "last.ckpt")
