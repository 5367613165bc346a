"""Training throughput of sdfnet beside a plain loop of the same network, in one run."""

import multiprocessing
import statistics
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

import torch
from lightning import Callback, LightningModule, Trainer
from torch import Tensor, nn
from torch.optim import Adam
from torch.utils.data import DataLoader, Dataset

from sdfnet.data.datamodule import ShapeFamily
from sdfnet.data.settings import BatchSettings
from sdfnet.data.store import read_distances, read_trajectory
from sdfnet.errors import ConfigurationError, TrainingError
from sdfnet.models.latents import latent_source_of
from sdfnet.models.mlp import mlp
from sdfnet.models.networks import Networks
from sdfnet.models.settings import ModelSettings
from sdfnet.training.fitting import fit_quietly
from sdfnet.training.losses import sdf_loss
from sdfnet.training.module import SdfTraining
from sdfnet.training.settings import OptimizerSettings, TrainingSettings

ROUNDS = 5  # each a stretch of sdfnet's training, then plain steps; the first round warms both up and is not counted
PLAIN_STEPS = 5  # of the plain loop a round, of which the median is taken: its first ones still meet sdfnet's threads spinning down


@dataclass(frozen=True)
class Throughput:
    """Pairs of shape and point trained on in a second: medians over interleaved rounds."""

    sdfnet: float
    plain: float

    @property
    def ratio(self) -> float:
        """How many times faster sdfnet trains."""
        return self.sdfnet / self.plain

    def words(self) -> str:
        """The two numbers and their ratio in a sentence."""
        return (
            f"Training sees {self.sdfnet / 1e6:.3g} million pairs of shape and point a second as train.py runs it, Lightning included; a plain loop of the "
            f"same network (DataLoader, whole shapes, eager, float32, concatenated input) {self.plain / 1e6:.3g} million: {self.ratio:.1f} times as many."
        )


def measured_throughput(family: ShapeFamily, model: ModelSettings, training: TrainingSettings, optimizer: OptimizerSettings, precision: str) -> Throughput:
    """Both speeds, measured in turns, on the prepared files of `family`.

    Raises ConfigurationError for a network that the plain loop does not have.
    """
    if model.conditioning != "first_layer" or model.activation == "siren":
        raise ConfigurationError(
            "the plain loop needs a latent that enters the first layer and weights that are not siren's, found "
            f"model.conditioning={model.conditioning} and model.activation={model.activation}; leave throughput out of studies"
        )
    with _plain_loop(family, model) as plain:
        rounds = InterleavedRounds(family, plain)
        fit_quietly(SdfTraining(family, model, replace(training, seconds=None, epochs=ROUNDS), optimizer), family, ROUNDS, precision, [rounds])
    return rounds.result()


class InterleavedRounds(Callback):
    """Times the epochs of a training, and after each has the plain loop take PLAIN_STEPS; give the trainer ROUNDS epochs."""

    def __init__(self, family: ShapeFamily, plain: Connection) -> None:
        self._family, self._connection = family, plain
        self._sdfnet: list[float] = []
        self._plain: list[float] = []

    def on_train_epoch_start(self, trainer: Trainer, module: LightningModule) -> None:
        """Start the clock."""
        self._began = time.perf_counter()

    def on_train_epoch_end(self, trainer: Trainer, module: LightningModule) -> None:
        """Read the clock, then have the plain loop take PLAIN_STEPS. Raises TrainingError when its process has ended."""
        batch = self._family.step(0, 0)
        self._sdfnet.append(batch.distances.numel() * self._family.steps_per_epoch / (time.perf_counter() - self._began))
        try:
            self._connection.send(True)
            self._plain.append(self._connection.recv())
        except (EOFError, OSError) as error:
            raise TrainingError("the plain loop's process has ended, perhaps for want of memory; leave throughput out of studies") from error

    def result(self) -> Throughput:
        """Medians without the warm-up round."""
        return Throughput(statistics.median(self._sdfnet[1:]), statistics.median(self._plain[1:]))


@contextmanager
def _plain_loop(family: ShapeFamily, model: ModelSettings) -> Iterator[Connection]:
    """The plain loop, waiting to be asked for steps, in a process of its own, as it would run: the memory settings of sdfnet's training do not help it."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_answer_with_plain_steps, args=(theirs, family.files.trajectory, family.files.distances, model), daemon=True)
    process.start()
    theirs.close()  # so that the end of the process ends a wait for it
    try:
        yield ours
    finally:
        process.kill()
        process.join()


def _answer_with_plain_steps(connection: Connection, trajectory: Path, distances: Path, model: ModelSettings) -> None:
    family = ShapeFamily.of(read_trajectory(trajectory), read_distances(distances), BatchSettings())
    box = family.samples.box
    networks = Networks(model, family.shapes, torch.from_numpy(box.lower).float(), torch.from_numpy(box.upper).float())
    steps = plain_training(family, networks)
    while True:
        connection.recv()
        connection.send(statistics.median(next(steps) for _ in range(PLAIN_STEPS)))


def plain_training(family: ShapeFamily, networks: Networks) -> Iterator[float]:
    """Steps of the loop that one writes first, each giving its pairs per second: one shape a batch with all the points that it kept."""
    plain = _PlainNetworks(family, networks)
    optimizer = Adam(plain.parameters(), lr=1e-3)
    loader = DataLoader(_WholeShapes(family), batch_size=1, shuffle=True)
    while True:
        began = time.perf_counter()
        for shape, points, distances in loader:
            optimizer.zero_grad()
            sdf_loss(plain(shape, points[0]), distances).backward()
            optimizer.step()
            yield distances.numel() / (time.perf_counter() - began)
            began = time.perf_counter()


class _WholeShapes(Dataset[tuple[Tensor, Tensor, Tensor]]):
    def __init__(self, family: ShapeFamily) -> None:
        self._family = family

    def __len__(self) -> int:
        return len(self._family.shapes)

    def __getitem__(self, frame: int) -> tuple[Tensor, Tensor, Tensor]:
        samples = self._family.samples
        kept = samples.kept[frame]
        return self._family.shapes[frame], torch.from_numpy(samples.points[kept]), torch.from_numpy(samples.distances[frame][kept])


class _PlainNetworks(nn.Module):
    """The same layers, the latent repeated for every point and concatenated with its encoding."""

    def __init__(self, family: ShapeFamily, networks: Networks) -> None:
        super().__init__()
        settings = networks.settings
        self.encoder = latent_source_of(settings, family.shapes)
        self.encoding: Any = networks.decoder.encoding
        self.centre, self.half_side = networks.decoder.centre, networks.decoder.half_side
        self.layers = mlp([settings.latent + self.encoding.features, *settings.decoder_widths, 1], settings.activation)

    def forward(self, shape: Tensor, points: Tensor) -> Tensor:
        latent = self.encoder(shape).expand(len(points), -1)
        encoded = self.encoding((points - self.centre) / self.half_side)
        return self.layers(torch.cat([latent, encoded], dim=1)).T
