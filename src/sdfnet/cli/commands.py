"""What each command does, as a function of its settings and of the folder to write to."""

import ctypes
import json
import logging
import platform
import time
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from lightning import LightningModule, Trainer, seed_everything
from lightning.pytorch.callbacks import Callback, RichProgressBar
from lightning.pytorch.loggers import TensorBoardLogger
from rich.console import Console
from rich.progress import Progress

from sdfnet.cli.settings import CostSettings, EvaluateSettings, PrepareSettings, TrainerSettings, TrainSettings
from sdfnet.cost.throughput import ROUNDS, InterleavedRounds, Throughput
from sdfnet.data.datamodule import ShapeFamily
from sdfnet.data.prepare import prepare as prepare_files
from sdfnet.data.prepare import prepare_mesh
from sdfnet.data.store import DistanceSamples, described, key_of, read_distances, read_trajectory, versions, written_whole
from sdfnet.errors import TrainingError
from sdfnet.evaluation.evaluate import Evaluation, EvaluationSettings
from sdfnet.evaluation.evaluate import evaluate as evaluate_networks
from sdfnet.evaluation.report import result_of, table_of, write_report
from sdfnet.geometry.bunny import beside_table_1
from sdfnet.geometry.solids import ClosedSurface
from sdfnet.models.networks import RECORD, Networks, load_networks, read_checkpoint
from sdfnet.physics.advisor import advise
from sdfnet.physics.advisor import lines as advice_lines
from sdfnet.physics.plan import plan
from sdfnet.physics.step_study import time_step_study
from sdfnet.physics.trajectory import Trajectory
from sdfnet.training.checkpoints import TimedCheckpoint, require_same_run, save_checkpoint
from sdfnet.training.losses import one_minus_cosine
from sdfnet.training.module import SdfTraining

logger = logging.getLogger(__name__)

MALLOC_OPTIONS = {-3: 1 << 30, -1: (1 << 31) - 1, -2: 64 << 20}  # M_MMAP_THRESHOLD, M_TRIM_THRESHOLD, M_TOP_PAD of malloc.h, bytes


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
        require_same_run(read_checkpoint(Path(settings.resume))[RECORD], module.identity())
    board = TensorBoardLogger(output, name="", version="tensorboard")
    trainer = _trainer(settings, output, board)
    with _steps_need_no_workers():
        trainer.fit(module, datamodule=family, ckpt_path=settings.resume, weights_only=True)
    save_checkpoint(trainer, output / "checkpoints" / "last.ckpt")
    family.to(torch.device("cpu"))
    seconds = {**family.files.seconds, "prepare": sum(family.files.seconds.values()), "train": module.train_seconds}
    # The same settings have the same hash wherever and however often they are run.
    run = {
        "configuration": key_of(replace(settings, resume=None, data_folder="", trainer=TrainerSettings())),
        "device": str(trainer.strategy.root_device),
        "seed": settings.seed,
        "split": settings.split,
        "settings": described(settings),
    }
    frames = family.train_frames.tolist()
    result, evaluation = _measure(module.networks, family.trajectory, family.samples, frames, settings.evaluation, output, seconds, run)
    _write_board(board, module.networks, family, evaluation, result)
    return float(result["chamfer_l1_mm_mean"])


def prepare(settings: PrepareSettings, output: Path) -> None:
    """Make the data that are missing, and print plan, advice and what was made; with plan_only make no more than the mesh."""
    folder, scene = Path(settings.data_folder), settings.dataset.scene
    files = None if settings.plan_only else prepare_files(settings.dataset, folder)
    mesh = prepare_mesh(settings.dataset, folder)
    console = Console(highlight=False, soft_wrap=True)
    if isinstance(scene.geometry, ClosedSurface) and scene.geometry.path is None:
        console.print(beside_table_1(mesh.nodes))
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


def cost(settings: CostSettings, output: Path) -> None:
    """Print and write what the time step, the mass and the way of training cost."""
    console = Console(highlight=False, soft_wrap=True)
    findings: dict[str, Any] = {"settings": described(settings), "versions": versions(), "threads": torch.get_num_threads()}
    if settings.measure in ("all", "step"):
        scene = settings.dataset.scene
        mesh = prepare_mesh(settings.dataset, Path(settings.data_folder))
        limits = plan(scene, mesh).limits
        console.print("\n".join(["step limits", *(["none: this integrator has no stability limit"] if limits is None else limits.lines())]))
        study = time_step_study(scene, mesh, settings.duration)
        console.print("\n".join(["", "time step: error against a tenth of the step, same mass", *study.lines()]))
        findings["step"] = described(study)
    if settings.measure in ("all", "throughput"):
        throughput = _throughput(settings, output)
        console.print("\n".join(["", "training throughput, medians of interleaved rounds", *throughput.lines()]))
        findings["throughput"] = described(throughput) | {"ratio": throughput.ratio}
    with written_whole(output / "cost.json") as unfinished:
        unfinished.write_text(json.dumps(findings, indent=2))
    console.print(f"written to {output}")


def _throughput(settings: CostSettings, output: Path) -> Throughput:
    keep_freed_memory()
    family = ShapeFamily(settings.dataset, Path(settings.data_folder), settings.batch)
    module = SdfTraining(family, settings.model, settings.training, settings.optimizer)
    rounds = InterleavedRounds(family, settings.model)
    trainer = Trainer(
        accelerator="cpu",
        precision=settings.precision,  # type: ignore[arg-type]
        max_epochs=ROUNDS,
        limit_val_batches=0,
        log_every_n_steps=1,
        callbacks=[rounds],
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
        default_root_dir=output,
    )
    with _steps_need_no_workers():
        trainer.fit(module, datamodule=family)
    return rounds.result()


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
    result = result_of(evaluation, networks, trajectory, train_frames, seconds, run)
    write_report(output, evaluation, result, trajectory)
    console = Console(highlight=False)
    console.print(table_of(result))
    console.print(f"seconds: {', '.join(f'{what} {value:.0f}' for what, value in seconds.items())}\nwritten to {output}")
    return result, evaluation


def _trainer(settings: TrainSettings, output: Path, board: TensorBoardLogger) -> Trainer:
    chosen = settings.trainer
    saved = TimedCheckpoint(output / "checkpoints" / "latest.ckpt", chosen.checkpoint_seconds)
    callbacks: list[Callback] = [saved, _TrainingBar(refresh_rate=20)] if chosen.progress_bar else [saved]
    return Trainer(
        accelerator=chosen.accelerator,
        devices=1,
        precision=chosen.precision,  # type: ignore[arg-type]
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


def keep_freed_memory() -> None:
    """Let glibc keep large freed blocks for the next step instead of giving them back and faulting every page in again."""
    if platform.libc_ver()[0] == "glibc":
        allocator = ctypes.CDLL(None)
        for option, size in MALLOC_OPTIONS.items():
            if not allocator.mallopt(option, size):  # an older glibc refuses so large a threshold; the others alone would only harm
                return


class _TrainingBar(RichProgressBar):
    """Lightning's, without the name of the logger's folder cut to four letters."""

    def get_metrics(self, trainer: Trainer, pl_module: LightningModule) -> dict[str, Any]:
        metrics = super().get_metrics(trainer, pl_module)
        metrics.pop("v_num", None)
        return metrics


@contextmanager
def _steps_need_no_workers() -> Iterator[None]:
    """Lightning advises more loader workers; steps are numbers, not files, and there is nothing for a worker to do."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*does not have many workers.*")
        warnings.filterwarnings("ignore", message=".*your dataloader is not resumable.*")  # nor anything to resume: a step is a pure function of its number
        warnings.filterwarnings("ignore", message=".*LeafSpec.*")  # inside Lightning 2.6
        yield


def _write_board(board: TensorBoardLogger, networks: Networks, family: ShapeFamily, evaluation: Evaluation, result: Mapping[str, Any]) -> None:
    """The last things that TensorBoard shows: cosine to the first frame (Figure 11), meshes, settings with their final metrics."""
    latents = networks.latents(family.shapes)
    for frame, gap in enumerate(one_minus_cosine(latents[:1].expand_as(latents), latents).tolist()):
        board.experiment.add_scalar("latent/cosine_to_first_by_frame", 1 - gap, frame)
    for frame, surfaces in evaluation.surfaces.items():
        for name, surface in surfaces.items():
            vertices, faces = torch.from_numpy(surface.vertices).float()[None], torch.from_numpy(surface.faces).int()[None]
            board.experiment.add_mesh(f"surface/{name}", vertices, faces=faces, global_step=frame)
    plain = {key: value for group in ("model", "optimizer", "training", "batch") for key, value in _flat(result["settings"][group], group)}
    board.log_hyperparams(
        plain | {"seed": result["seed"]}, {f"final/{name}": float(result[name]) for name in ("chamfer_l1_mm_mean", "chamfer_l1_mm_worst", "decoder_parameters")}
    )
    board.finalize("success")


def _flat(settings: Mapping[str, Any], prefix: str) -> list[tuple[str, Any]]:
    return [(f"{prefix}.{key}", value if isinstance(value, str | int | float | bool) else str(value)) for key, value in settings.items() if key != "kind"]
