"""What may not be resumed, and how it is said."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch

from sdfnet.cli import commands
from sdfnet.cli.settings import TrainSettings
from sdfnet.errors import TrainingError
from sdfnet.models.networks import RECORD
from tests.runs.resumable_run import BALL, EPOCHS, SMALL, Outcome, Recipe, Run


def test_a_checkpoint_between_the_last_step_and_the_epochs_end_is_refused(recipe: Recipe, whole: Outcome, run: Run) -> None:
    last = len(whole.steps) // EPOCHS - 1
    message = "was written between the last step of epoch 1 and its end, .*; resume from one that TimedCheckpoint wrote, or one of an epoch's end"
    with pytest.raises(TrainingError, match=message):
        run(recipe, resume=whole.checkpoints / f"step-1-{last}.ckpt")


@pytest.fixture(scope="module")
def checkpoint(run: Run, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Of the small recipe's first epoch."""
    folder = tmp_path_factory.mktemp("first-epoch")
    run(SMALL, folder, epochs=1)
    return folder / "epoch-0.ckpt"


def test_resuming_with_another_model_is_refused_with_both_sizes(run: Run, checkpoint: Path) -> None:
    other = replace(SMALL, model=replace(SMALL.model, width=16, latent=3))
    message = r"differs from this run in model.width \(8 there, 16 here\), model.latent \(4 there, 3 here\); resume with the settings and data"
    with pytest.raises(TrainingError, match=message):
        run(other, resume=checkpoint)


def test_resuming_another_run_is_refused_by_name(run: Run, checkpoint: Path) -> None:
    other = replace(SMALL, batch=replace(SMALL.batch, stride=SMALL.batch.stride + 1))
    with pytest.raises(TrainingError, match=r"the checkpoint differs from this run in batch.stride \(3 there, 4 here\); resume with the settings and data"):
        run(other, resume=checkpoint)


def test_resuming_another_run_is_refused_before_any_data_are_made(checkpoint: Path) -> None:
    settings = TrainSettings(BALL, SMALL.model, SMALL.batch, SMALL.optimizer, SMALL.training, resume=str(checkpoint), data_folder="not-yet")
    for other, message in (
        (replace(settings, model=replace(SMALL.model, width=16)), r"in model.width \(8 there, 16 here\);"),
        (replace(settings, seed=1), r"in seed \(0 there, 1 here\);"),
        (replace(settings, split="interpolation"), r"in train_frames \(5 entries \[0, 1, 2, 3, 4\] there, 4 entries \[0, 1, 3, 4\] here\);"),
    ):
        with pytest.raises(TrainingError, match=message):
            commands.train(other, Path("run"))
    assert not Path("not-yet").exists()


def test_resuming_with_other_data_is_refused_with_both_files(run: Run, checkpoint: Path, tmp_path: Path) -> None:
    contents = torch.load(checkpoint, weights_only=True)
    contents[RECORD]["distances"] = "distances-of-old.h5"
    torch.save(contents, tmp_path / "other.ckpt")
    with pytest.raises(TrainingError, match=r"in distances \('distances-of-old.h5' there, 'distances-\w+.h5' here\); resume with the settings and data"):
        run(SMALL, resume=tmp_path / "other.ckpt")


def test_a_checkpoint_of_another_program_cannot_be_resumed(run: Run, checkpoint: Path, tmp_path: Path) -> None:
    contents = torch.load(checkpoint, weights_only=True)
    del contents[RECORD]
    torch.save(contents, tmp_path / "foreign.ckpt")
    message = "is (a checkpoint )?of another program, expected one written by train.py"
    with pytest.raises(TrainingError, match=message):
        run(SMALL, resume=tmp_path / "foreign.ckpt")
    with pytest.raises(TrainingError, match=message):
        commands.train(TrainSettings(BALL, resume=str(tmp_path / "foreign.ckpt")), Path("run"))
    with pytest.raises(TrainingError, match=r"no checkpoint at 'nowhere\.ckpt'"):
        commands.train(TrainSettings(BALL, resume="nowhere.ckpt"), Path("run"))
