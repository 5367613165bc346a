"""When checkpoints are written, what they hold, and which run they belong to."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
import torch
from lightning import LightningModule, Trainer

from sdfnet.errors import StoreError, TrainingError
from sdfnet.models.networks import RECORD, load_networks
from sdfnet.training import checkpoints
from sdfnet.training.checkpoints import TimedCheckpoint, require_same_run, save_checkpoint
from sdfnet.training.settings import OptimizerSettings, TrainingSettings
from tests.training.short_run import BOTH, FRAMES, MODEL, SHARED, SOAP, Start


@pytest.fixture
def trainer() -> Trainer:
    return Trainer(accelerator="cpu", logger=False, enable_checkpointing=False, enable_progress_bar=False)


def test_a_checkpoint_is_written_when_its_time_has_passed_and_not_before(trainer: Trainer, monkeypatch: pytest.MonkeyPatch) -> None:
    clock: list[float] = [100.0]
    calls: list[float] = []

    def save(path: Path) -> None:
        calls.append(clock[0])
        path.write_text(f"of {clock[0]}")

    monkeypatch.setattr(trainer, "save_checkpoint", save)
    monkeypatch.setattr(checkpoints.time, "monotonic", lambda: clock[0])
    callback, batch = TimedCheckpoint(Path("latest.ckpt"), seconds=60.0), None
    written: list[int] = []
    for clock[0] in (100.0, 159.0, 160.0, 219.0, 230.0, 231.0):
        callback.on_train_batch_start(trainer, LightningModule(), batch, 0)
        written.append(len(calls))
    assert written == [0, 0, 1, 1, 2, 2]
    assert Path("latest.ckpt").read_text() == "of 230.0"
    assert [path.name for path in Path().iterdir()] == ["latest.ckpt"]


@pytest.mark.parametrize("writes_half", [True, False], ids=["full disk", "nothing written"])
def test_a_checkpoint_that_cannot_be_written_is_an_error_and_spares_the_last_one(trainer: Trainer, monkeypatch: pytest.MonkeyPatch, writes_half: bool) -> None:
    def fill_up(path: Path) -> None:
        path.write_text("half")
        raise OSError(28, "No space left on device")

    Path("latest.ckpt").write_text("the last")
    monkeypatch.setattr(trainer, "save_checkpoint", fill_up if writes_half else lambda path: None)  # Lightning passes over a missing permission in silence
    with pytest.raises(StoreError, match=r"'latest\.ckpt' could not be written: .*No (space left|such file).*; free some space or choose another folder"):
        save_checkpoint(trainer, Path("latest.ckpt"))
    assert Path("latest.ckpt").read_text() == "the last"
    assert [path.name for path in Path().iterdir()] == ["latest.ckpt"]


@pytest.mark.parametrize("optimizer", [OptimizerSettings(), SOAP], ids=["plateau", "cosine"])
def test_a_run_whose_seconds_are_over_takes_no_further_step(start: Start, tmp_path: Path, optimizer: OptimizerSettings) -> None:
    training = TrainingSettings(epochs=1000, cycle=BOTH, seconds=0.1)
    whole = start(SHARED, training, optimizer).fit()
    whole.trainer.save_checkpoint(tmp_path / "last.ckpt")
    again = start(SHARED, training, optimizer)
    again.trainer.fit(again.module, datamodule=again.family, ckpt_path=tmp_path / "last.ckpt", weights_only=True)
    assert again.trainer.fit_loop.total_batch_idx == whole.trainer.fit_loop.total_batch_idx > 0
    assert all(torch.equal(one, other) for one, other in zip(again.module.networks.parameters(), whole.module.networks.parameters(), strict=True))


def plain(value: Any) -> bool:
    """Whether a value is made of tensors, numbers, text and containers only."""
    if isinstance(value, Mapping):
        return all(plain(key) and plain(item) for key, item in value.items())
    if isinstance(value, list | tuple | set):
        return all(plain(item) for item in value)
    return value is None or type(value) in (bool, int, float, str, torch.Tensor)


@pytest.mark.parametrize("optimizer", [OptimizerSettings(), SOAP], ids=["adam", "soap"])
def test_a_checkpoint_holds_only_plain_values_and_says_what_it_is_of(start: Start, folder: Path, tmp_path: Path, optimizer: OptimizerSettings) -> None:
    run = start(SHARED, TrainingSettings(epochs=1, cycle=BOTH), optimizer).fit()
    run.trainer.save_checkpoint(tmp_path / "last.ckpt")
    contents = torch.load(tmp_path / "last.ckpt", weights_only=True)
    assert plain(contents)
    assert contents[RECORD]["model"] == vars(MODEL)
    assert contents[RECORD]["train_frames"] == list(range(FRAMES))
    assert {(folder / contents[RECORD][what]).is_file() for what in ("trajectory", "distances")} == {True}
    found = load_networks(tmp_path / "last.ckpt")
    points = torch.rand(9, 3) * 0.1
    assert torch.equal(found(run.family.shapes, points), run.module.networks(run.family.shapes, points))


def test_a_run_is_refused_with_every_difference_and_both_values() -> None:
    saved = {"model": {"width": 8, "latent": 4}, "train_frames": list(range(10)), "trajectory": "trajectory-1.h5", "seed": 0}
    require_same_run(saved, saved)
    require_same_run(saved, {name: value for name, value in saved.items() if name != "trajectory"})  # before the data are made
    asked = {"model": {"width": 16, "latent": 4, "depth": 2}, "train_frames": list(range(8)), "trajectory": "trajectory-1.h5", "seed": 1}
    message = (
        r"the checkpoint differs from this run in model.width \(8 there, 16 here\), model.depth \(nothing there, 2 here\), train_frames \(10 entries "
        r"\[0, 1, 2, 3, 4, 5, \.\.\.\] there, 8 entries .* here\), seed \(0 there, 1 here\); resume with the settings and data that it was trained with"
    )
    with pytest.raises(TrainingError, match=message):
        require_same_run(saved, asked)
    with pytest.raises(TrainingError, match=r"in model.latent \(4 there, nothing here\);"):
        require_same_run(saved, {**saved, "model": {"width": 8}})
