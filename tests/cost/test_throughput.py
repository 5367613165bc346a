"""The plain loop that training is timed beside."""

import multiprocessing
from contextlib import nullcontext
from dataclasses import replace
from itertools import count
from multiprocessing.connection import Connection
from pathlib import Path
from types import SimpleNamespace
from unittest import mock

import pytest
import torch

from sdfnet.cost import throughput
from sdfnet.cost.throughput import Throughput, _PlainNetworks, measured_throughput, plain_training
from sdfnet.data.datamodule import ShapeFamily
from sdfnet.data.settings import BatchSettings
from sdfnet.errors import ConfigurationError, TrainingError
from sdfnet.models.decoder import OUTPUT_UNIT
from sdfnet.models.networks import Networks
from sdfnet.models.settings import ModelSettings
from sdfnet.plugins import find_datasets
from tests.cost.conftest import MODEL, OPTIMIZER, TRAINING

ROOT = Path(__file__).parents[2]


def test_the_plain_loop_trains_the_same_network(tmp_path: Path) -> None:
    family = ShapeFamily(find_datasets([ROOT / "datasets"])["sphere_squeeze"], tmp_path, BatchSettings())
    family.setup()
    box = family.samples.box
    networks = Networks(ModelSettings(width=8, latent=4), family.shapes, torch.from_numpy(box.lower).float(), torch.from_numpy(box.upper).float())
    plain = _PlainNetworks(family, networks)
    plain.encoder.load_state_dict(networks.encoder.state_dict())
    decoder = networks.decoder
    weight = torch.cat([decoder.from_latent.weight, decoder.from_point.weight], dim=1)
    plain.layers[0].load_state_dict({"weight": weight, "bias": decoder.from_latent.bias})
    plain.layers[2:].load_state_dict({f"{int(name[0]) + 2}{name[1:]}": values for name, values in decoder.layers.state_dict().items()})
    points = torch.from_numpy(family.samples.points[:50])
    ours = networks(family.shapes[3:4], points) / (OUTPUT_UNIT * decoder.half_side)
    assert torch.allclose(plain(family.shapes[3:4], points), ours, atol=1e-6)


def test_speeds_are_measured_over_all_rounds_whatever_limits_the_training(ball_family: ShapeFamily, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = mock.MagicMock(spec=Connection)  # the true one's process takes seconds to start
    asked.recv.side_effect = [1.0, 2.0, 4.0, 5.0, 30.0]
    monkeypatch.setattr(throughput, "_plain_loop", lambda family, model: nullcontext(asked))
    seconds = count(step=0.25)
    monkeypatch.setattr(throughput, "time", SimpleNamespace(perf_counter=lambda: next(seconds)))
    speed = measured_throughput(ball_family, MODEL, replace(TRAINING, seconds=1e-3, epochs=1), OPTIMIZER, "32-true")
    assert speed.plain == 4.5, "the median without the first round"
    assert Throughput(3e6, 6e5).words().endswith("0.6 million: 5.0 times as many.")
    settings = ball_family.batch
    assert settings.points_per_step is not None
    assert speed.sdfnet == settings.frames_per_step * settings.points_per_step * ball_family.steps_per_epoch / 0.25


def test_plain_loop_tells_the_pairs_of_a_second(ball_family: ShapeFamily, monkeypatch: pytest.MonkeyPatch) -> None:
    seconds = count(step=0.25)
    monkeypatch.setattr(throughput, "time", SimpleNamespace(perf_counter=lambda: next(seconds)))
    box = ball_family.samples.box
    networks = Networks(MODEL, ball_family.shapes, torch.from_numpy(box.lower).float(), torch.from_numpy(box.upper).float())
    assert next(plain_training(ball_family, networks)) == ball_family.samples.kept.shape[1] / 0.25


def test_plain_loop_ends_with_a_training_that_diverges(ball_family: ShapeFamily) -> None:
    with pytest.raises(TrainingError, match="not finite"):
        measured_throughput(ball_family, MODEL, TRAINING, replace(OPTIMIZER, decoder_rate=1e30), "32-true")
    assert multiprocessing.active_children() == []


def test_plain_loop_that_dies_is_said(ball_family: ShapeFamily, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Connection, "recv", mock.Mock(side_effect=EOFError))
    with pytest.raises(TrainingError, match="the plain loop's process has ended, perhaps for want of memory; leave throughput out of studies"):
        measured_throughput(ball_family, MODEL, TRAINING, OPTIMIZER, "32-true")


@pytest.mark.parametrize("model", [replace(MODEL, conditioning="modulated"), replace(MODEL, activation="siren")])
def test_network_that_the_plain_loop_does_not_have_is_refused(ball_family: ShapeFamily, model: ModelSettings) -> None:
    found = f"found model.conditioning={model.conditioning} and model.activation={model.activation}; leave throughput out of studies"
    with pytest.raises(ConfigurationError, match=found):
        measured_throughput(ball_family, model, TRAINING, OPTIMIZER, "32-true")
