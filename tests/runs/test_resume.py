"""A stopped run that is resumed ends where an uninterrupted one does, bit for bit on the CPU."""

import os
import signal
from pathlib import Path
from typing import Any

import pytest
import torch
from lightning import LightningModule, Trainer
from lightning.pytorch.callbacks import Callback

from sdfnet.stopping import SIGNALS
from sdfnet.stopping import Stopped as RunStopped
from sdfnet.training.checkpoints import TimedCheckpoint
from sdfnet.training.cycle import phase_at
from tests.runs.resumable_run import EPOCHS, PAPER, TURNS, Journal, Outcome, Recipe, RequireSameEnd, Run, Stopped


def test_the_uninterrupted_run_has_what_resuming_could_get_wrong(recipe: Recipe, whole: Outcome) -> None:
    assert [phase_at(TURNS, epoch).trains for epoch in range(EPOCHS)] == ["both", "both", "encoder", "decoder", "decoder", "both", "both"]
    assert whole.steps == [(epoch, step) for epoch in range(EPOCHS) for step in range(len(whole.steps) // EPOCHS)]
    if recipe is PAPER:
        # readings of each scheduler: five steps in each of epochs 1 to 3, one validation in each of epochs 2 to 7
        assert [scheduler["last_epoch"] for scheduler in whole.state[2]] == [15, 15, 6, 6]
        assert whole.readings[EPOCHS - 1]["rate/decoder"] < PAPER.optimizer.decoder_rate
    assert all(torch.isfinite(torch.tensor(list(reading.values()))).all() for reading in whole.readings.values())


def test_a_run_repeated_is_bit_equal(recipe: Recipe, whole: Outcome, run: Run, same_end: RequireSameEnd) -> None:
    same_end(run(recipe), whole, "the start")


@pytest.mark.parametrize("epoch", range(EPOCHS - 1))
def test_a_run_stopped_at_an_epochs_end_resumes_bit_equal(recipe: Recipe, whole: Outcome, run: Run, epoch: int, same_end: RequireSameEnd) -> None:
    resumed = run(recipe, resume=whole.checkpoints / f"epoch-{epoch}.ckpt")
    assert resumed.steps[0] == (epoch + 1, 0)
    same_end(resumed, whole, f"the end of epoch {epoch}")


@pytest.mark.parametrize("epoch", range(EPOCHS))
def test_a_run_stopped_in_the_middle_of_an_epoch_resumes_bit_equal(recipe: Recipe, whole: Outcome, run: Run, epoch: int, same_end: RequireSameEnd) -> None:
    steps = len(whole.steps) // EPOCHS
    for step in {0, steps - 2}:  # after the first step of the epoch, and before the last
        resumed = run(recipe, resume=whole.checkpoints / f"step-{epoch}-{step}.ckpt")
        assert resumed.steps[0] == (epoch, step + 1)
        same_end(resumed, whole, f"step {step} of epoch {epoch}")


def test_a_run_that_breaks_off_resumes_bit_equal(recipe: Recipe, whole: Outcome, run: Run, tmp_path: Path, same_end: RequireSameEnd) -> None:
    with pytest.raises(Stopped):
        run(recipe, journal=Journal(tmp_path, stop_after=(3, 1)))
    same_end(run(recipe, resume=tmp_path / "step-3-1.ckpt"), whole, "the break")


def test_a_run_that_came_to_its_end_goes_on_bit_equal(recipe: Recipe, whole: Outcome, run: Run, tmp_path: Path, same_end: RequireSameEnd) -> None:
    run(recipe, epochs=3).trainer.save_checkpoint(tmp_path / "last.ckpt")
    resumed = run(recipe, resume=tmp_path / "last.ckpt")
    assert resumed.steps[0] == (3, 0)
    same_end(resumed, whole, "the end of a shorter run")


def test_a_run_stopped_twice_resumes_bit_equal(recipe: Recipe, whole: Outcome, run: Run, tmp_path: Path, same_end: RequireSameEnd) -> None:
    run(recipe, tmp_path, resume=whole.checkpoints / "step-1-1.ckpt")
    for name in ("step-1-2", "epoch-1", "step-4-0", "epoch-4"):
        same_end(run(recipe, resume=tmp_path / f"{name}.ckpt"), whole, f"{name} of a resumed run")


class Signal(Callback):
    """Sends this process a signal in the middle of a step."""

    def __init__(self, number: int, epoch: int, step: int) -> None:
        self.number, self.at = number, (epoch, step)

    def on_after_backward(self, trainer: Trainer, pl_module: LightningModule) -> None:
        if (trainer.current_epoch, trainer.fit_loop.epoch_loop.batch_idx) == self.at:
            os.kill(os.getpid(), self.number)


@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_run_told_to_stop_in_a_step_finishes_it_and_resumes_bit_equal(
    recipe: Recipe, whole: Outcome, run: Run, tmp_path: Path, same_end: RequireSameEnd, number: int, code: int
) -> None:
    last = len(whole.steps) // EPOCHS - 1
    for epoch, step in ((0, 0), (1, last)):  # long before its time; and in an epoch's last step, where a validation is still to come
        handlers = [signal.getsignal(one) for one in SIGNALS]
        latest = tmp_path / f"{epoch}-{step}.ckpt"
        with pytest.raises(RunStopped) as stopped:
            run(recipe, more=(TimedCheckpoint(latest, seconds=1e9), Signal(number, epoch, step)))
        assert stopped.value.exit_code == code
        assert [signal.getsignal(one) for one in SIGNALS] == handlers
        resumed = run(recipe, resume=latest)
        assert resumed.steps[0] == whole.steps[whole.steps.index((epoch, step)) + 1]
        same_end(resumed, whole, f"the stop in step {step} of epoch {epoch}")


class EveryTimedCheckpoint(TimedCheckpoint):
    """A timed checkpoint whose time has always come, each kept under its own name."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder / "latest.ckpt", seconds=0.0)
        self.folder = folder

    def on_train_batch_start(self, trainer: Trainer, pl_module: LightningModule, batch: Any, batch_idx: int) -> None:
        super().on_train_batch_start(trainer, pl_module, batch, batch_idx)
        self._path.rename(self.folder / f"before-{trainer.current_epoch}-{batch_idx}.ckpt")


@pytest.fixture(scope="session")
def timed(recipe: Recipe, run: Run, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What TimedCheckpoint would have left, had the run stopped before any of its steps."""
    folder = tmp_path_factory.mktemp("timed")
    run(recipe, more=(EveryTimedCheckpoint(folder),))
    return folder


@pytest.mark.parametrize("epoch", range(EPOCHS))
def test_a_run_resumed_from_a_timed_checkpoint_is_bit_equal(
    recipe: Recipe, whole: Outcome, timed: Path, run: Run, epoch: int, same_end: RequireSameEnd
) -> None:
    last = len(whole.steps) // EPOCHS - 1
    for step in (0, last):  # the first comes after the validation of the epoch before it
        resumed = run(recipe, resume=timed / f"before-{epoch}-{step}.ckpt")
        assert resumed.steps[0] == (epoch, step)
        same_end(resumed, whole, f"before step {step} of epoch {epoch}")
