"""Whole small trainings through Lightning, by the paper's recipe and by ours, that can be stopped anywhere and compared at their ends."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback

from sdfnet.data.datamodule import ShapeFamily
from sdfnet.data.settings import BatchSettings
from sdfnet.geometry.solids import Sphere
from sdfnet.models.settings import ModelSettings
from sdfnet.physics.effects.pressure_poke import PressurePoke
from sdfnet.scene import Dataset, Effect, Recording, Sampling, Scene
from sdfnet.training.cycle import Phase
from sdfnet.training.module import SdfTraining
from sdfnet.training.schedules import Plateau
from sdfnet.training.settings import OptimizerSettings, TrainingSettings

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
RECIPES = {"paper": PAPER, "small in bf16": replace(SMALL, precision="bf16-mixed")}


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


@dataclass(eq=False)
class Outcome:
    """How a run ended and which way it went."""

    state: list[Any]  # weights, optimizers, schedulers
    steps: list[tuple[int, int]]
    readings: dict[int, dict[str, float]]
    trainer: Trainer
    checkpoints: Path


def train(
    recipe: Recipe,
    data: Path,
    readings: Any,
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
    journal = journal or Journal(checkpoints)
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


Run = Callable[..., Outcome]
RequireSameEnd = Callable[[Outcome, Outcome, str], None]


def require_same_end(resumed: Outcome, whole: Outcome, equal: Callable[[Any, Any], bool], origin: str) -> None:
    """The resumed run took exactly the steps that were left, logged the same, and ended in the same state."""
    assert resumed.steps == whole.steps[len(whole.steps) - len(resumed.steps) :], origin
    for what, ours, theirs in zip(("weights", "optimizers", "schedulers"), resumed.state, whole.state, strict=True):
        assert equal(ours, theirs), f"{what} differ when resumed from {origin}"
    for epoch, reading in resumed.readings.items():
        assert reading == whole.readings[epoch], f"{origin}: epoch {epoch}"
