"""Checkpoints from which a run goes on exactly, wherever it was stopped."""

import time
from pathlib import Path
from typing import Any

from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback


class TimedCheckpoint(Callback):
    """Writes `path` again whenever `seconds` have passed, always just before a step.

    Not Lightning's ModelCheckpoint, which writes just after one: when that was an epoch's last step, Lightning resumes
    with the next epoch and leaves out the validation in between, which the second plateau listens to.
    """

    def __init__(self, path: Path, seconds: float) -> None:
        self._path, self._seconds = path, seconds
        self._written = time.monotonic()

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        """Write if it is time."""
        if time.monotonic() - self._written >= self._seconds:
            trainer.save_checkpoint(self._path)
            self._written = time.monotonic()
