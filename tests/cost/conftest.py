"""A small ball, prepared once, and a network trained on it for a moment."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from sdfnet.data.datamodule import ShapeFamily
from sdfnet.data.settings import BatchSettings
from sdfnet.data.store import DistanceSamples
from sdfnet.geometry.solids import Sphere
from sdfnet.models.networks import Networks
from sdfnet.models.settings import ModelSettings
from sdfnet.physics.trajectory import Trajectory
from sdfnet.plugins import find_datasets
from sdfnet.scene import Dataset
from sdfnet.training.cycle import Phase
from sdfnet.training.settings import OptimizerSettings, TrainingSettings
from tests.evaluation.shape_family import ball_trajectory, samples_of

MODEL = ModelSettings(width=16, depth=2, latent=4, encoding="fourier", frequencies=12, frequency_scale=0.5)
TRAINING = TrainingSettings(epochs=4, cycle=(Phase("both", 1),), power=1, focus=0.004, latent_weight=0.0)
OPTIMIZER = OptimizerSettings(encoder_rate=0.002, decoder_rate=0.005, schedule="linear")


@pytest.fixture(scope="session")
def ball() -> Dataset:
    """The squeezed ball with few tets and points."""
    found = find_datasets([Path(__file__).parents[2] / "datasets"])["sphere_squeeze"]
    scene = replace(found.scene, geometry=Sphere(radius=0.05, cells=4))
    return replace(found, scene=scene, sampling=replace(found.sampling, count=4000, near_surface_count=4000))


@pytest.fixture(scope="session")
def ball_family(ball: Dataset, tmp_path_factory: pytest.TempPathFactory) -> ShapeFamily:
    """Its shapes and distances, ready to train on."""
    batch = BatchSettings(frames_per_step=4, stride=4, points_per_step=512, near_share=0.7, steps_per_epoch=40, validation_points=256)
    family = ShapeFamily(ball, tmp_path_factory.mktemp("ball"), batch)
    family.prepare_data()
    family.setup()
    return family


def ball_networks(family: ShapeFamily) -> Networks:
    """A decoder that answers |x - centre| - r in the box's own units: positive outside, one closed surface."""
    box = family.samples.box
    networks = Networks(MODEL, family.shapes, torch.from_numpy(box.lower).float(), torch.from_numpy(box.upper).float())

    class Ball(torch.nn.Module):
        def forward(self, hidden: torch.Tensor) -> torch.Tensor:
            return hidden[..., :1]

    decoder = networks.decoder
    decoder.encoded = lambda points: (points - decoder.centre).norm(dim=-1, keepdim=True).expand(*points.shape[:-1], 16) / decoder.half_side  # type: ignore[method-assign]
    with torch.no_grad():
        decoder.from_latent.weight.zero_()
        decoder.from_latent.bias.fill_(-0.4)
    decoder.activation, decoder.layers = torch.nn.Identity(), Ball()  # type: ignore[assignment]
    return networks


@pytest.fixture(scope="module")
def trajectory() -> Trajectory:
    """A ball that is deformed."""
    return ball_trajectory(4)


@pytest.fixture(scope="module")
def samples(trajectory: Trajectory) -> DistanceSamples:
    """Its distances."""
    return samples_of(trajectory)
