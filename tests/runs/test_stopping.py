"""A command that is told to stop says how to go on, and what it says goes on as if nothing had been."""

import os
import re
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch

from sdfnet.cli import commands
from sdfnet.data import prepare
from sdfnet.training.module import SdfTraining

SHORT = ("experiment=smoke", "trainer.progress_bar=false", "dataset.scene.geometry.cells=4", "training.epochs=3", "batch.steps_per_epoch=4", "model.width=8")
EVALUATION = ("evaluation.resolution=24", "evaluation.surface_samples=2000", "evaluation.volume_samples=2000", "evaluation.mesh_frames=[]")
Command = Callable[..., None]


@pytest.fixture
def tell(monkeypatch: pytest.MonkeyPatch) -> Callable[..., None]:
    """`tell(signal, owner, name)` sends this process a signal in the middle of the second call of `owner.name`."""

    def arrange(number: int, owner: Any, name: str) -> None:
        calls, original = [0], getattr(owner, name)

        def interrupted(*arguments: Any, **named: Any) -> Any:
            calls[0] += 1
            if calls[0] == 2:
                os.kill(os.getpid(), number)
            return original(*arguments, **named)

        monkeypatch.setattr(owner, name, interrupted)

    return arrange


def weights_of(folder: Path) -> Any:
    return torch.load(folder / "checkpoints" / "last.ckpt", weights_only=True)["state_dict"]


def stopped(command: Command, *words: str) -> int:
    with pytest.raises(SystemExit) as ended:
        command(*words)
    assert isinstance(ended.value.code, int)
    return ended.value.code


def test_a_stopped_training_goes_on_by_the_command_that_it_prints_with_nothing_typed_again(
    command: Command, tell: Callable[..., None], equal: Callable[[Any, Any], bool], capfd: pytest.CaptureFixture[str]
) -> None:
    command("train", *SHORT, *EVALUATION, "hydra.run.dir=whole")
    with pytest.MonkeyPatch.context() as only_here:
        only_here.setattr(SdfTraining, "on_train_epoch_end", SdfTraining.on_train_epoch_end)  # put back what `tell` changes
        tell(signal.SIGINT, SdfTraining, "training_step")
        assert stopped(command, "train", *SHORT, *EVALUATION, "hydra.run.dir=broken") == 130
    _, err = capfd.readouterr()
    assert "Traceback" not in err
    assert (said := re.search(r"^train: stopped; go on with: python train\.py (resume=.*/broken/checkpoints/latest\.ckpt)$", err, flags=re.MULTILINE))
    command("train", said[1], "hydra.run.dir=resumed")
    assert "taken from the run in" in (out := capfd.readouterr().out)
    assert " ".join((*SHORT, *EVALUATION)) in out
    assert equal(weights_of(Path("resumed")), weights_of(Path("whole")))
    assert "model.width=8" in Path("resumed/.hydra/overrides.yaml").read_text()  # so that this run can be resumed in turn

    with pytest.raises(SystemExit):
        command("train", said[1], "model.width=16")
    assert "model.width (8 there, 16 here)" in capfd.readouterr().err


def test_a_training_told_to_stop_in_its_last_step_keeps_its_last_checkpoint(
    command: Command, tell: Callable[..., None], capfd: pytest.CaptureFixture[str]
) -> None:
    tell(signal.SIGTERM, SdfTraining, "on_train_epoch_end")
    assert stopped(command, "train", *SHORT, *EVALUATION, "training.epochs=2", "hydra.run.dir=run") == 143
    assert "resume=" in (err := capfd.readouterr().err)
    assert "run/checkpoints/last.ckpt" in err


def test_a_stopped_preparation_says_so_in_one_line_and_leaves_no_empty_folder(
    command: Command, tell: Callable[..., None], capfd: pytest.CaptureFixture[str]
) -> None:
    before = signal.getsignal(signal.SIGINT)
    tell(signal.SIGINT, prepare, "read_mesh")
    assert stopped(command, "prepare", "dataset=sphere_squeeze", "dataset.scene.geometry.cells=4", "data_folder=data") == 130
    out, err = capfd.readouterr()
    assert "Traceback" not in out + err
    assert "prepare: stopped; what was finished is kept, and the same command goes on from there: python prepare.py dataset=sphere_squeeze" in err
    assert not list(Path("outputs").rglob("overrides.yaml"))
    assert signal.getsignal(signal.SIGINT) is before


def test_a_checkpoint_is_evaluated_as_its_run_was_unless_something_else_is_typed(command: Command, capfd: pytest.CaptureFixture[str]) -> None:
    command("train", *SHORT, *EVALUATION, "training.epochs=1", "hydra.run.dir=run", "data_folder=data")
    asked: list[Any] = []

    def measure(*given: Any) -> tuple[dict[str, float], None]:
        asked.append(given[4])
        return {"chamfer_l1_mm_mean": 0.0}, None

    with pytest.MonkeyPatch.context() as only_here:
        only_here.setattr(commands, "_measure", measure)
        command("evaluate", "checkpoint=run/checkpoints/last.ckpt", "evaluation.every=2")
    assert "data_folder=" in capfd.readouterr().out
    (settings,) = asked
    assert (settings.resolution, settings.volume_samples, settings.mesh_frames) == (24, 2000, ())  # the run's
    assert settings.every == 2  # typed; the run had 5
