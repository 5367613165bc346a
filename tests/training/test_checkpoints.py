"""When checkpoints are written."""

from pathlib import Path

import pytest
from lightning import LightningModule, Trainer

from sdfnet.training import checkpoints
from sdfnet.training.checkpoints import TimedCheckpoint


def test_a_checkpoint_is_written_when_its_time_has_passed_and_not_before(monkeypatch: pytest.MonkeyPatch) -> None:
    clock: list[float] = [100.0]
    paths: list[Path] = []
    trainer = Trainer(accelerator="cpu", logger=False, enable_checkpointing=False, enable_progress_bar=False)
    monkeypatch.setattr(trainer, "save_checkpoint", lambda path, *_: paths.append(path))
    monkeypatch.setattr(checkpoints.time, "monotonic", lambda: clock[0])
    callback, batch = TimedCheckpoint(Path("latest.ckpt"), seconds=60.0), None
    written: list[int] = []
    for clock[0] in (100.0, 159.0, 160.0, 219.0, 230.0, 231.0):
        callback.on_train_batch_start(trainer, LightningModule(), batch, 0)
        written.append(len(paths))
    assert written == [0, 0, 1, 1, 2, 2]
    assert set(paths) == {Path("latest.ckpt")}
