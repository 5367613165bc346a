"""Short trainings of a squeezed ball: what the tests of this folder set up, and what they look at."""

from collections.abc import Callable
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
from sdfnet.training.settings import OptimizerSettings, TrainingSettings

FRAMES = 5
EFFECTS: dict[str, Effect] = {side: PressurePoke(center=(x, 0.0, 0.0), radius=0.03, pressure=3000.0) for side, x in (("left", -0.05), ("right", 0.05))}
BALL = Dataset(Scene(Sphere(cells=4), EFFECTS, recording=Recording(duration=0.002, frames=FRAMES)), Sampling(count=1500, near_surface_count=800))
MODEL = ModelSettings(width=8, depth=2, latent=4)
PAIRS = BatchSettings(validation_points=100)
SHARED = BatchSettings(frames_per_step=3, stride=3, points_per_step=100, near_share=0.5, steps_per_epoch=4, ordered_epochs=0, validation_points=100)
BOTH = (Phase("both", 1),)
TURNS = (Phase("both", 2), Phase("encoder", 2), Phase("decoder", 3))
SOAP = OptimizerSettings("soap", 0.002, 0.003, "cosine", 0.1)


class Before(Callback):
    """Calls a function before every step."""

    def __init__(self, call: Callable[[SdfTraining, int, int], None]) -> None:
        self._call = call

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        assert isinstance(pl_module, SdfTraining)
        self._call(pl_module, trainer.current_epoch, batch_idx)


class Run:
    """A short training on the ball, with what came of it."""

    def __init__(self, folder: Path, readings: Any, batch: BatchSettings, training: TrainingSettings, optimizer: OptimizerSettings, **trainer: Any) -> None:
        torch.manual_seed(0)
        self.family = ShapeFamily(BALL, folder, batch)
        self.module = SdfTraining(self.family, MODEL, training, optimizer)
        self.readings = readings
        settings: dict[str, Any] = {
            "accelerator": "cpu",
            "max_epochs": training.epochs,
            "check_val_every_n_epoch": training.validate_every,
            "num_sanity_val_steps": 0,
            "logger": self.readings,
            "log_every_n_steps": 1,
            "enable_checkpointing": False,
            "enable_progress_bar": False,
            "enable_model_summary": False,
        }
        self.trainer = Trainer(**settings | trainer)

    def fit(self) -> "Run":
        self.trainer.fit(self.module, datamodule=self.family)
        return self


Start = Callable[..., Run]
