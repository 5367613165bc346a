"""What each command does, as a function of its settings and of the folder to write to."""

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from lightning import LightningModule, Trainer, seed_everything
from lightning.pytorch.callbacks import Callback, RichProgressBar
from lightning.pytorch.loggers import TensorBoardLogger
from rich.progress import Progress

from sdfnet.cli.board import write_board
from sdfnet.cli.muted import muted
from sdfnet.cli.screen import screen
from sdfnet.cli.settings import EvaluateSettings, PrepareSettings, TrainSettings
from sdfnet.cost.machine import machine
from sdfnet.data.datamodule import ShapeFamily
from sdfnet.data.prepare import prepare as prepare_files
from sdfnet.data.prepare import prepare_mesh
from sdfnet.data.store import DistanceSamples, described, key_of, read_distances, read_trajectory
from sdfnet.errors import TrainingError
from sdfnet.evaluation.evaluate import Evaluation
from sdfnet.evaluation.evaluate import evaluate as evaluate_networks
from sdfnet.evaluation.report import result_of, table_of, write_report
from sdfnet.evaluation.settings import EvaluationSettings
from sdfnet.geometry.bunny import beside_table_1
from sdfnet.geometry.solids import ClosedSurface
from sdfnet.models.networks import RECORD, Networks, load_networks, read_checkpoint
from sdfnet.physics.advisor import advise
from sdfnet.physics.advisor import lines as advice_lines
from sdfnet.physics.plan import plan
from sdfnet.physics.trajectory import Trajectory
from sdfnet.training.checkpoints import TimedCheckpoint, save_checkpoint
from sdfnet.training.fitting import keep_freed_memory, resolved_precision, steps_need_no_workers
from sdfnet.training.module import SdfTraining


def train(settings: TrainSettings, output: Path) -> float:
    """Prepare what is missing, train, evaluate; the mean chamfer_l1 in mm is what a sweep minimises."""
    keep_freed_memory()
    if settings.trainer.threads is not None:
        torch.set_num_threads(settings.trainer.threads)
    settings.evaluation.require_frames(settings.dataset.scene.frame_count)
    seed_everything(settings.seed, verbose=False)
    family = ShapeFamily(settings.dataset, Path(settings.data_folder), settings.batch, settings.split, settings.seed)
    module = SdfTraining(family, settings.model, settings.training, settings.optimizer)
    if settings.resume is not None:  # asked again with the names of the files, once they are made
        module.require_resumable(read_checkpoint(Path(settings.resume), "resume")[RECORD])
    board = TensorBoardLogger(output, name="", version="tensorboard")
    latest = TimedCheckpoint(output / "checkpoints" / "latest.ckpt", settings.trainer.checkpoint_seconds)
    trainer = _trainer(settings, output, board, latest)
    with steps_need_no_workers():
        trainer.fit(module, datamodule=family, ckpt_path=settings.resume, weights_only=True)
    save_checkpoint(trainer, output / "checkpoints" / "last.ckpt")
    latest.stop_if_told()
    family.to(torch.device("cpu"))
    seconds = {**family.files.seconds, "prepare": sum(family.files.seconds.values()), "train": module.train_seconds}
    run = {
        "configuration": settings.key,
        "device": str(trainer.strategy.root_device),
        "precision": trainer.precision,
        **machine(),
        "seed": settings.seed,
        "split": settings.split,
        "files": family.file_names,
        "settings": described(settings),
    }
    frames = family.train_frames.tolist()
    result, evaluation = _measure(module.networks, family.trajectory, family.samples, frames, settings.evaluation, output, seconds, run)
    write_board(board, family, evaluation, result)
    return float(result["chamfer_l1_mm_mean"])


def prepare(settings: PrepareSettings, output: Path) -> None:
    """Make the data that are missing, and print plan, advice and what was made; with plan_only make no more than the mesh."""
    folder, scene = Path(settings.data_folder), settings.dataset.scene
    files = None if settings.plan_only else prepare_files(settings.dataset, folder)
    mesh = prepare_mesh(settings.dataset, folder)
    console = screen()
    if isinstance(scene.geometry, ClosedSurface) and scene.geometry.path is None:
        console.print(beside_table_1(mesh.nodes))
    said = files is not None and "simulation" in files.built
    with muted(*(["sdfnet.physics"] if said else [])):
        compiled = plan(scene, mesh)
    console.print(compiled.describe())
    console.print("\n".join(["advice", *(f"  {line}" for line in advice_lines(advise(compiled)))]))
    if files is not None:
        report = read_trajectory(files.trajectory).report
        console.print("\n".join(f"{name}: {value}" for name, value in report.items()))
        console.print(f"the steps took {float(report['step_seconds']):.2g} s when they were run; what the plan predicts is for now")
        for what, path in (("tet mesh", files.mesh), ("simulation", files.trajectory), ("signed distances", files.distances)):
            console.print(f"{what}: {path} ({'made' if what in files.built else 'was there'}, {files.seconds[what]:.1f} s)")


def evaluate(settings: EvaluateSettings, output: Path) -> float:
    """Measure a checkpoint on the prepared data that it was trained on."""
    checkpoint = Path(settings.checkpoint)
    record = read_checkpoint(checkpoint)[RECORD]
    if "trajectory" not in record:
        raise TrainingError(f"'{checkpoint}' was trained on arrays at hand, not on prepared files; measure it there with sdfnet.evaluation.evaluate")
    networks, folder = load_networks(checkpoint), Path(settings.data_folder)
    trajectory, samples = read_trajectory(folder / record["trajectory"]), read_distances(folder / record["distances"])
    run = {"checkpoint": str(checkpoint), "configuration": key_of(record), "settings": described(record)}
    return float(_measure(networks, trajectory, samples, record["train_frames"], settings.evaluation, output, {}, run)[0]["chamfer_l1_mm_mean"])


def _measure(
    networks: Networks,
    trajectory: Trajectory,
    samples: DistanceSamples,
    train_frames: list[int],
    settings: EvaluationSettings,
    output: Path,
    seconds: Mapping[str, float],
    run: Mapping[str, Any],
) -> tuple[dict[str, Any], Evaluation]:
    """Evaluate, print the table, write the report."""
    began = time.perf_counter()
    with Progress() as bars:
        task = bars.add_task("evaluation", total=None)
        unseen = set(range(len(trajectory.times))) - set(train_frames)
        evaluation = evaluate_networks(networks, trajectory, samples, settings, lambda done, total: bars.update(task, completed=done, total=total), unseen)
    seconds = {**seconds, "evaluate": time.perf_counter() - began}
    result = result_of(evaluation, trajectory, train_frames, seconds, run)
    write_report(output, evaluation, result, trajectory)
    console = screen()
    console.print(table_of(result))
    console.print(f"seconds: {', '.join(f'{what} {value:.0f}' for what, value in seconds.items())}\nwritten to {output}")
    return result, evaluation


def _trainer(settings: TrainSettings, output: Path, board: TensorBoardLogger, latest: TimedCheckpoint) -> Trainer:
    chosen = settings.trainer
    callbacks: list[Callback] = [latest, *([_TrainingBar(refresh_rate=20)] if chosen.progress_bar else [])]
    return Trainer(
        accelerator=chosen.accelerator,
        devices=1,
        precision=resolved_precision(chosen.precision, chosen.accelerator),
        max_epochs=settings.training.epochs,
        check_val_every_n_epoch=settings.training.validate_every,
        log_every_n_steps=1,
        num_sanity_val_steps=0,
        callbacks=callbacks,
        enable_checkpointing=False,
        logger=board,
        enable_progress_bar=chosen.progress_bar,
        enable_model_summary=False,
        default_root_dir=output,
    )


class _TrainingBar(RichProgressBar):
    """Lightning's, without the name of the logger's folder cut to four letters, and with epochs counted from one."""

    def _get_train_description(self, current_epoch: int) -> str:
        return f"Epoch {current_epoch + 1}/{self.trainer.max_epochs}".ljust(len(self.validation_description))  # all bars begin in one column

    def get_metrics(self, trainer: Trainer, pl_module: LightningModule) -> dict[str, Any]:
        metrics = super().get_metrics(trainer, pl_module)
        metrics.pop("v_num", None)
        return metrics
