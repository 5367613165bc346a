"""Whole small runs through Lightning: a stopped run that is resumed ends where an uninterrupted one does, bit for bit on the CPU."""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback
from lightning.pytorch.loggers import Logger
from torch import Tensor

from sdfnet.cli.commands import _require_same_model
from sdfnet.cli.settings import TrainSettings
from sdfnet.data.datamodule import BatchSettings, ShapeFamily
from sdfnet.data.prepare import prepare
from sdfnet.errors import TrainingError
from sdfnet.geometry.solids import Sphere
from sdfnet.models.settings import ModelSettings
from sdfnet.physics.effects.pressure_poke import PressurePoke
from sdfnet.scene import Dataset, Effect, Recording, Sampling, Scene
from sdfnet.training.checkpoints import TimedCheckpoint
from sdfnet.training.cycle import Phase, phase_at
from sdfnet.training.module import SdfTraining
from sdfnet.training.schedules import Plateau
from sdfnet.training.settings import OptimizerSettings, TrainingSettings

pytestmark = [
    pytest.mark.filterwarnings("ignore:.*does not have many workers"),  # steps are numbers, there is nothing for a worker to do
    pytest.mark.filterwarnings("ignore:.*your dataloader is not resumable"),  # nor anything to resume: a step is a pure function of its number
    pytest.mark.filterwarnings("ignore:.*LeafSpec"),  # inside Lightning 2.6
]

EFFECTS: dict[str, Effect] = {side: PressurePoke(center=(x, 0.0, 0.0), radius=0.03, pressure=2000.0) for side, x in (("left", -0.05), ("right", 0.05))}
BALL = Dataset(Scene(Sphere(cells=4), EFFECTS, recording=Recording(duration=0.002, frames=5)), Sampling(count=2000, near_surface_count=1000))
EPOCHS = 7
TURNS = (Phase("both", 2), Phase("encoder", 1), Phase("decoder", 2))  # epochs 0-1, 2, 3-4, then both again


@dataclass(frozen=True)
class Recipe:
    """Everything that a training is told."""

    model: ModelSettings
    batch: BatchSettings
    training: TrainingSettings
    optimizer: OptimizerSettings
    precision: str = "32-true"


PAPER = Recipe(
    ModelSettings(width=8, latent=4),
    BatchSettings(ordered_epochs=2, validation_points=100),
    TrainingSettings(EPOCHS, TURNS),
    # rates so high and patience so short that the rates fall
    OptimizerSettings(encoder_rate=0.05, decoder_rate=0.05, plateaus=(Plateau(1, 3, "batch", 1, 0.92), Plateau(2, None, "validation", 0, 0.75))),
)
SMALL = Recipe(
    ModelSettings(width=8, depth=2, taper=False, latent=4, encoding="fourier", frequencies=4),
    BatchSettings(frames_per_step=3, stride=3, points_per_step=100, near_share=0.5, steps_per_epoch=4, ordered_epochs=0, validation_points=100),
    TrainingSettings(EPOCHS, TURNS, power=1, focus=0.01, latent_weight=0.0, validate_every=2),
    OptimizerSettings("soap", 0.002, 0.003, "cosine", 0.1),
)
RECIPES = {"paper": PAPER, "small": SMALL, "small in bf16": replace(SMALL, precision="bf16-mixed")}


class Journal(Callback):
    """Writes down the steps taken; saves a checkpoint after each of them and at each epoch's end, where a folder is given."""

    def __init__(self, folder: Path | None, stop_after: tuple[int, int] | None = None) -> None:
        self.folder, self.stop_after = folder, stop_after
        self.steps: list[tuple[int, int]] = []

    def on_train_batch_end(self, trainer: Trainer, pl_module: LightningModule, outputs: Any, batch: Any, batch_idx: int) -> None:
        self.steps.append((trainer.current_epoch, batch_idx))
        if self.folder is not None:
            trainer.save_checkpoint(self.folder / f"step-{trainer.current_epoch}-{batch_idx}.ckpt")
        if self.steps[-1] == self.stop_after:
            raise Stopped

    def on_train_epoch_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if self.folder is not None:
            trainer.save_checkpoint(self.folder / f"epoch-{trainer.current_epoch}.ckpt")


class Stopped(Exception):
    """The machine goes down."""


class Readings(Logger):
    """Keeps what is logged, by epoch."""

    def __init__(self) -> None:
        super().__init__()
        self.of_epoch: dict[int, dict[str, float]] = {}

    @property
    def name(self) -> str:
        return "readings"

    @property
    def version(self) -> int:
        return 0

    def log_hyperparams(self, *arguments: Any, **named: Any) -> None:
        """There is nothing to keep."""

    def log_metrics(self, metrics: Mapping[str, float], step: int | None = None) -> None:
        assert step is not None
        self.of_epoch[step] = dict(metrics)


@dataclass(eq=False)
class Outcome:
    """How a run ended and which way it went."""

    state: list[Any]  # weights, optimizers, schedulers
    steps: list[tuple[int, int]]
    readings: dict[int, dict[str, float]]
    trainer: Trainer
    checkpoints: Path


def run(
    recipe: Recipe,
    data: Path,
    checkpoints: Path | None = None,
    resume: Path | None = None,
    epochs: int = EPOCHS,
    journal: Journal | None = None,
    more: tuple[Callback, ...] = (),
) -> Outcome:
    """Train from the start, or on from a checkpoint; a resumed run begins with other random numbers, none of which may matter."""
    torch.manual_seed(0 if resume is None else 99)
    family = ShapeFamily(BALL, data, recipe.batch)
    module = SdfTraining(family, recipe.model, recipe.training, recipe.optimizer)
    journal, readings = journal or Journal(checkpoints), Readings()
    trainer = Trainer(
        accelerator="cpu",
        precision=recipe.precision,  # type: ignore[arg-type]
        max_epochs=epochs,
        check_val_every_n_epoch=recipe.training.validate_every,
        num_sanity_val_steps=0,
        callbacks=[journal, *more],
        logger=readings,
        log_every_n_steps=1,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
    )
    trainer.fit(module, datamodule=family, ckpt_path=resume, weights_only=True)
    schedulers = [configured.scheduler.state_dict() for configured in trainer.lr_scheduler_configs]
    state = [module.networks.state_dict(), [optimizer.state_dict() for optimizer in trainer.optimizers], schedulers]
    return Outcome(state, journal.steps, readings.of_epoch, trainer, checkpoints or Path())


def equal(first: Any, second: Any) -> bool:
    """Bit-equal, through dictionaries and lists."""
    if isinstance(first, Tensor):
        return torch.equal(first, second)
    if isinstance(first, Mapping):
        return first.keys() == second.keys() and all(equal(first[key], second[key]) for key in first)
    if isinstance(first, list | tuple):
        return len(first) == len(second) and all(equal(one, other) for one, other in zip(first, second, strict=True))
    return bool(first == second)


def require_same_end(resumed: Outcome, whole: Outcome, origin: str) -> None:
    """The resumed run took exactly the steps that were left, logged the same, and ended in the same state."""
    assert resumed.steps == whole.steps[len(whole.steps) - len(resumed.steps) :], origin
    for what, ours, theirs in zip(("weights", "optimizers", "schedulers"), resumed.state, whole.state, strict=True):
        assert equal(ours, theirs), f"{what} differ when resumed from {origin}"
    for epoch, reading in resumed.readings.items():
        assert reading == whole.readings[epoch], f"{origin}: epoch {epoch}"


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("data")
    prepare(BALL, made)
    return made


@pytest.fixture(scope="module", params=RECIPES)
def recipe(request: pytest.FixtureRequest) -> Recipe:
    return RECIPES[request.param]


@pytest.fixture(scope="module")
def whole(recipe: Recipe, data: Path, tmp_path_factory: pytest.TempPathFactory) -> Outcome:
    """The uninterrupted run, with a checkpoint after every step and every epoch."""
    return run(recipe, data, tmp_path_factory.mktemp("checkpoints"))


def test_the_uninterrupted_run_has_what_resuming_could_get_wrong(recipe: Recipe, whole: Outcome) -> None:
    assert [phase_at(TURNS, epoch).trains for epoch in range(EPOCHS)] == ["both", "both", "encoder", "decoder", "decoder", "both", "both"]
    assert whole.steps == [(epoch, step) for epoch in range(EPOCHS) for step in range(len(whole.steps) // EPOCHS)]
    if recipe is PAPER:
        # readings of each scheduler: five steps in each of epochs 1 to 3, one validation in each of epochs 2 to 7
        assert [scheduler["last_epoch"] for scheduler in whole.state[2]] == [15, 15, 6, 6]
        assert whole.readings[EPOCHS - 1]["rate/decoder"] < PAPER.optimizer.decoder_rate
    assert all(torch.isfinite(torch.tensor(list(reading.values()))).all() for reading in whole.readings.values())


def test_a_run_repeated_is_bit_equal(recipe: Recipe, whole: Outcome, data: Path) -> None:
    require_same_end(run(recipe, data), whole, "the start")


@pytest.mark.parametrize("epoch", range(EPOCHS - 1))
def test_a_run_stopped_at_an_epochs_end_resumes_bit_equal(recipe: Recipe, whole: Outcome, data: Path, epoch: int) -> None:
    resumed = run(recipe, data, resume=whole.checkpoints / f"epoch-{epoch}.ckpt")
    assert resumed.steps[0] == (epoch + 1, 0)
    require_same_end(resumed, whole, f"the end of epoch {epoch}")


@pytest.mark.parametrize("epoch", range(EPOCHS))
def test_a_run_stopped_in_the_middle_of_an_epoch_resumes_bit_equal(recipe: Recipe, whole: Outcome, data: Path, epoch: int) -> None:
    steps = len(whole.steps) // EPOCHS
    for step in {0, steps - 2}:  # after the first step of the epoch, and before the last
        resumed = run(recipe, data, resume=whole.checkpoints / f"step-{epoch}-{step}.ckpt")
        assert resumed.steps[0] == (epoch, step + 1)
        require_same_end(resumed, whole, f"step {step} of epoch {epoch}")


def test_a_run_that_breaks_off_resumes_bit_equal(recipe: Recipe, whole: Outcome, data: Path, tmp_path: Path) -> None:
    with pytest.raises(Stopped):
        run(recipe, data, journal=Journal(tmp_path, stop_after=(3, 1)))
    require_same_end(run(recipe, data, resume=tmp_path / "step-3-1.ckpt"), whole, "the break")


def test_a_run_that_came_to_its_end_goes_on_bit_equal(recipe: Recipe, whole: Outcome, data: Path, tmp_path: Path) -> None:
    run(recipe, data, epochs=3).trainer.save_checkpoint(tmp_path / "last.ckpt")
    resumed = run(recipe, data, resume=tmp_path / "last.ckpt")
    assert resumed.steps[0] == (3, 0)
    require_same_end(resumed, whole, "the end of a shorter run")


def test_a_run_stopped_twice_resumes_bit_equal(recipe: Recipe, whole: Outcome, data: Path, tmp_path: Path) -> None:
    run(recipe, data, tmp_path, resume=whole.checkpoints / "step-1-1.ckpt")
    for name in ("step-1-2", "epoch-1", "step-4-0", "epoch-4"):
        require_same_end(run(recipe, data, resume=tmp_path / f"{name}.ckpt"), whole, f"{name} of a resumed run")


class EveryTimedCheckpoint(TimedCheckpoint):
    """A timed checkpoint whose time has always come, each kept under its own name."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder / "latest.ckpt", seconds=0.0)
        self.folder = folder

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        super().on_train_batch_start(trainer, pl_module, batch, batch_idx)
        self._path.rename(self.folder / f"before-{trainer.current_epoch}-{batch_idx}.ckpt")


@pytest.fixture(scope="module")
def timed(recipe: Recipe, data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What TimedCheckpoint would have left, had the run stopped before any of its steps."""
    folder = tmp_path_factory.mktemp("timed")
    run(recipe, data, more=(EveryTimedCheckpoint(folder),))
    return folder


@pytest.mark.parametrize("epoch", range(EPOCHS))
def test_a_run_resumed_from_a_timed_checkpoint_is_bit_equal(recipe: Recipe, whole: Outcome, timed: Path, data: Path, epoch: int) -> None:
    last = len(whole.steps) // EPOCHS - 1
    for step in (0, last):  # the first comes after the validation of the epoch before it
        resumed = run(recipe, data, resume=timed / f"before-{epoch}-{step}.ckpt")
        assert resumed.steps[0] == (epoch, step)
        require_same_end(resumed, whole, f"before step {step} of epoch {epoch}")


def test_a_checkpoint_between_the_last_step_and_the_epochs_end_is_refused(recipe: Recipe, whole: Outcome, data: Path) -> None:
    last = len(whole.steps) // EPOCHS - 1
    message = "was written between the last step of epoch 1 and its end, .*; resume from one that TimedCheckpoint wrote, or one of an epoch's end"
    with pytest.raises(TrainingError, match=message):
        run(recipe, data, resume=whole.checkpoints / f"step-1-{last}.ckpt")


def test_training_brings_the_error_down(data: Path) -> None:
    settings = TrainingSettings(12, (Phase("both", 1),), power=1, focus=0.01, latent_weight=0.0)
    batch = replace(SMALL.batch, points_per_step=400, steps_per_epoch=25)
    model = replace(SMALL.model, width=24, frequencies=12, frequency_scale=0.5)
    readings = run(Recipe(model, batch, settings, replace(SMALL.optimizer, decoder_rate=0.01)), data, epochs=12).readings
    assert readings[11]["loss/validation_mean"] < 0.2 * readings[0]["loss/validation_mean"]


def test_resuming_with_another_model_is_refused_with_both_sizes(data: Path, tmp_path: Path) -> None:
    run(SMALL, data, tmp_path, epochs=1)
    checkpoint = tmp_path / "epoch-0.ckpt"
    _require_same_model(checkpoint, TrainSettings(dataset=BALL, model=SMALL.model))
    message = "is of another model: width 8 there, 16 here; latent 4 there, 3 here; resume with the same model settings"
    with pytest.raises(TrainingError, match=message):
        _require_same_model(checkpoint, TrainSettings(dataset=BALL, model=replace(SMALL.model, width=16, latent=3)))


def test_resuming_another_run_is_refused_by_name(data: Path, tmp_path: Path) -> None:
    run(SMALL, data, tmp_path, epochs=1)
    other = replace(SMALL, batch=replace(SMALL.batch, stride=SMALL.batch.stride + 1))
    with pytest.raises(TrainingError, match="the checkpoint differs from this run in batch; resume with the settings and data"):
        run(other, data, resume=tmp_path / "epoch-0.ckpt")
