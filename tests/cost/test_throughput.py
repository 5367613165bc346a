"""The plain loop that training is timed beside."""

from pathlib import Path

import torch

from sdfnet.cost.throughput import _PlainNetworks
from sdfnet.data.datamodule import ShapeFamily
from sdfnet.data.settings import BatchSettings
from sdfnet.models.decoder import OUTPUT_UNIT
from sdfnet.models.networks import Networks
from sdfnet.models.settings import ModelSettings
from sdfnet.plugins import find_datasets

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
