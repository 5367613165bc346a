"""Checkpoints from which a run goes on exactly, wherever it was stopped, and only that run."""

import reprlib
import time
from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from types import FrameType
from typing import Any

from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback

from sdfnet.data.store import written_whole
from sdfnet.errors import TrainingError
from sdfnet.stopping import Stopped, signals_handled


class TimedCheckpoint(Callback):
    """Writes `path` again whenever `seconds` have passed and when the run is told to stop, always just before a step.

    Not Lightning's ModelCheckpoint, which writes just after one: when that was an epoch's last step, Lightning resumes
    with the next epoch and leaves out the validation in between, which the second plateau listens to. Told to stop by
    Ctrl-C or SIGTERM, it waits for the next step, writes and raises Stopped; told twice, it stops at once.
    """

    def __init__(self, path: Path, seconds: float) -> None:
        self._path, self._seconds = path, seconds
        self._written = time.monotonic()
        self._told: int | None = None  # the signal that told the run to stop
        self._handled = ExitStack()

    def on_train_start(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """From here on wait with stopping for a step that can be resumed from."""
        self._handled.enter_context(signals_handled(self._remember))

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        """Write if it is time. Raises Stopped when told to."""
        if self._told is not None or time.monotonic() - self._written >= self._seconds:
            save_checkpoint(trainer, self._path)
            self._written = time.monotonic()
        self.stop_if_told()

    def on_train_end(self, trainer: Trainer, pl_module: LightningModule) -> None:
        """No step is left to wait for."""
        self._handled.close()

    def on_exception(self, trainer: Trainer, pl_module: LightningModule, exception: BaseException) -> None:
        """No step is left to wait for."""
        self._handled.close()

    def stop_if_told(self) -> None:
        """Raise Stopped when a signal came that was not followed: after the last step this waits for the last checkpoint."""
        if self._told is not None:
            raise Stopped(self._told)

    def _remember(self, number: int, frame: FrameType | None) -> None:
        self.stop_if_told()
        self._told = number


def save_checkpoint(trainer: Trainer, path: Path) -> None:
    """Write a checkpoint in one move: a full disk or a kill spares the one that was there. Raises StoreError when it cannot be written.

    Lightning alone writes to the system's folder for temporary files and copies from there when that is another disk,
    and it passes over a missing permission in silence.
    """
    with written_whole(path) as unfinished:
        trainer.save_checkpoint(unfinished)


def require_same_run(saved: Mapping[str, Any], asked: Mapping[str, Any]) -> None:
    """Raise TrainingError when what a checkpoint says of its run differs from what is asked, naming each setting with both values.

    Entries that only the checkpoint has are not compared: before the data are made a run does not know its files.
    """
    there, here = _by_path({name: saved.get(name) for name in asked}), _by_path(asked)
    different = [name for name in {**here, **there} if name not in here or name not in there or here[name] != there[name]]
    if different:
        listed = ", ".join(f"{name} ({_shown(name, there)} there, {_shown(name, here)} here)" for name in different)
        raise TrainingError(f"the checkpoint differs from this run in {listed}; resume with the settings and data that it was trained with")


def _by_path(settings: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings as one level, `model.width` and the like."""
    flat: dict[str, Any] = {}
    for name, value in settings.items():
        flat |= _by_path(value, f"{prefix}{name}.") if isinstance(value, Mapping) else {f"{prefix}{name}": value}
    return flat


def _shown(name: str, settings: Mapping[str, Any]) -> str:
    if name not in settings:
        return "nothing"
    value = settings[name]
    return f"{len(value)} entries {reprlib.repr(value)}" if isinstance(value, list | tuple) else reprlib.repr(value)
