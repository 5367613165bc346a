"""What a sweep found: its jobs read back from their folders, seeds summed up, and the smallest network that is good enough."""

import json
import math
import statistics
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from sdfnet.cost.frontier import knee
from sdfnet.data.store import write_json
from sdfnet.errors import ConfigurationError
from sdfnet.evaluation.field_errors import EikonalErrors, FieldErrors, VolumeErrors
from sdfnet.evaluation.metrics import SurfaceErrors

JOB_FILE, RESULT_FILE, PLAN_FILE = "job.json", "result.json", "planned.json"
FINISHED, FAILED, LEFT_OUT, RUNNING, NOT_STARTED = "finished", "failed", "left out", "running", "not started"
FRAMES = ("worst", "mean")
SIZES = ("decoder_parameters", "query_bytes")
JOB_COLUMNS = (
    "decoder_parameters", "encoder_parameters", "query_bytes", "chamfer_l1_mm_mean", "chamfer_l1_mm_worst", "knn1_chamfer_l1_mm_mean",
    "knn1_chamfer_l1_mm_worst", "floor_chamfer_l1_mm_mean", "hausdorff_mm_worst", "normal_degrees_mean", "failed_frames", "distinct_latents",
    "train_seconds",
)  # fmt: skip
ERRORS = tuple(f"{entry.name}_{frames}" for kind in (SurfaceErrors, VolumeErrors, FieldErrors) for entry in fields(kind) for frames in FRAMES)
EIKONAL = tuple(entry.name for entry in fields(EikonalErrors))
# What a sweeper may minimise; those of frames never trained on are there where the split leaves frames out.
OBJECTIVES = tuple(dict.fromkeys((*JOB_COLUMNS, *ERRORS, *EIKONAL, *(f"unseen_chamfer_l1_mm_{frames}" for frames in FRAMES))))


@dataclass(frozen=True)
class Target:
    """What `target.*` sets: which network counts as good enough."""

    chamfer_l1_mm: float | None = None  # none: as good as KNN-1, the paper's "ideal", on the same frames
    frames: str = "worst"  # worst or mean: which of a run's errors must be that small
    size: str = "decoder_parameters"  # what is to be small: these, or query_bytes, the decoder as it is stored and the latents of all frames
    skip_larger: bool = False  # leave out jobs that are larger than a network that already is good enough: they cannot win
    objectives: tuple[str, ...] = ("chamfer_l1_mm_mean",)  # entries of result.json that a sweeper such as Optuna minimises

    def __post_init__(self) -> None:
        if self.frames not in FRAMES:
            raise ConfigurationError(f"target.frames must be one of {', '.join(FRAMES)}; found '{self.frames}'")
        if self.size not in SIZES:
            raise ConfigurationError(f"target.size must be one of {', '.join(SIZES)}; found '{self.size}'")
        if self.chamfer_l1_mm is not None and not self.chamfer_l1_mm > 0:
            raise ConfigurationError(f"target.chamfer_l1_mm must be positive, found {self.chamfer_l1_mm}")
        if not self.objectives:
            raise ConfigurationError("target.objectives must name at least one entry of result.json, found none")
        unknown = [name for name in self.objectives if name not in OBJECTIVES]
        if unknown:
            raise ConfigurationError(f"target.objectives must be one of {', '.join(OBJECTIVES)}; found '{unknown[0]}'")

    @property
    def metric(self) -> str:
        """The entry of result.json that is compared."""
        return f"chamfer_l1_mm_{self.frames}"

    def allowed(self, result: dict[str, Any]) -> float | None:
        """The largest error (mm) that is good enough in a run; none where KNN-1, which was to be reached, has no surface."""
        if self.chamfer_l1_mm is not None:
            return self.chamfer_l1_mm
        knn1 = result[f"knn1_{self.metric}"]
        return None if knn1 is None else float(knn1)

    def words(self) -> str:
        """The target in a sentence."""
        where = {"worst": "on the worst frame", "mean": "on average over the frames"}
        return f"{'KNN-1' if self.chamfer_l1_mm is None else f'{self.chamfer_l1_mm:g} mm'} {where[self.frames]}"


@dataclass(frozen=True)
class Job:
    """One job of a sweep as its folder tells it."""

    folder: Path
    overrides: tuple[str, ...]
    status: str
    reason: str = ""  # why it failed or was left out
    result: dict[str, Any] | None = None  # of a finished job
    configuration: str = ""  # the key of the settings that its files were made with

    @property
    def setting(self) -> tuple[str, ...]:
        """What jobs of one row share: its overrides without the seed and without those that change no result."""
        return tuple(override for override in self.overrides if changes_result(override) and overridden(override) != "seed")


@dataclass(frozen=True)
class Row:
    """One setting over its seeds: medians, and the range over the seeds that finished."""

    setting: tuple[str, ...]
    overrides: tuple[str, ...]  # of the job whose error is the median of the seeds; of two the better
    seeds: int  # that finished
    decoder_parameters: int
    query_bytes: int
    chamfer_l1_mm_mean: float
    chamfer_l1_mm_mean_range: tuple[float, float]
    chamfer_l1_mm_worst: float
    chamfer_l1_mm_worst_range: tuple[float, float]
    train_seconds: float
    threads: int | None  # of PyTorch, of the job of these overrides; none of a result that does not say it
    is_within_target: bool  # by the median over the seeds, never by the best of them

    def error(self, target: Target) -> float:
        """The error (mm) that the target names."""
        return float(getattr(self, target.metric))

    def size(self, target: Target) -> float:
        """The size that the target names: parameters or bytes."""
        return float(getattr(self, target.size))


def write_plan(sweep_folder: Path, planned: Mapping[str, Sequence[str]] | None) -> None:
    """Keep which jobs a sweep asks for, the overrides by the folder's name; none for a sweeper that chooses as it goes: then every job in the folder counts."""
    sweep_folder.mkdir(parents=True, exist_ok=True)
    if planned is None:
        (sweep_folder / PLAN_FILE).unlink(missing_ok=True)
        return
    write_json(sweep_folder / PLAN_FILE, planned)


def read_plan(sweep_folder: Path) -> dict[str, Any] | None:
    """The overrides of the jobs that a sweep asks for, by the folder's name; none of a sweeper that chooses as it goes."""
    return _contents(sweep_folder / PLAN_FILE)


def read_jobs(sweep_folder: Path) -> list[Job]:
    """Every job that a sweep asks for, in its order; without a plan all that were started, in the order of their folders' names."""
    planned = read_plan(sweep_folder)
    if planned is None:
        planned = {path.parent.name: [] for path in sorted(sweep_folder.glob(f"*/{JOB_FILE}"))}
    return [read_job(sweep_folder / name, overrides) for name, overrides in planned.items()]


def read_job(folder: Path, planned: Sequence[str] = ()) -> Job:
    """A job as its folder tells it: without a whole job.json it was not started, without a whole result.json it is not finished."""
    written = _contents(folder / JOB_FILE)
    if written is None:
        return Job(folder, tuple(planned), NOT_STARTED)
    status, reason, result = written["status"], written["reason"], None
    if status == RUNNING:
        reason = "stopped, or still under way"
    if status == FINISHED:
        result = _contents(folder / RESULT_FILE)
        status, reason = (RUNNING, f"its {RESULT_FILE} is missing or broken") if result is None else (FINISHED, reason)
    return Job(folder, tuple(written["overrides"]), status, reason, result, written["configuration"])


def unplanned(sweep_folder: Path) -> list[str]:
    """The folders of jobs that the sweep once had and no longer asks for."""
    planned = read_plan(sweep_folder)
    started = [path.parent.name for path in sorted(sweep_folder.glob(f"*/{JOB_FILE}"))]
    return [] if planned is None else [name for name in started if name not in planned]


def rows_of(jobs: Sequence[Job], target: Target) -> list[Row]:
    """Finished jobs, those of one setting summed up, by the size that the target names, then by the error that it does."""
    finished: dict[tuple[str, ...], list[Job]] = {}
    for job in jobs:
        if job.result is not None:
            finished.setdefault(job.setting, []).append(job)
    rows = [_row(setting, seeds, target) for setting, seeds in finished.items()]
    return sorted(rows, key=lambda row: (row.size(target), row.error(target)))


def overridden(override: str) -> str:
    """`model.width` of `model.width=64`, `effect@weight` of `+effect@weight=gravity`."""
    return override.split("=", 1)[0].lstrip("+~")


def changes_result(override: str) -> bool:
    """Whether it changes a job or its result, and not only where and how the job runs."""
    return overridden(override) != "data_folder" and not overridden(override).startswith(("hydra.", "hydra/", "target."))


def shared_overrides(jobs: Sequence[Job]) -> set[str]:
    """The overrides that every job has, and that need not be said of each."""
    return set.intersection(*[set(job.setting) for job in jobs]) if len({job.setting for job in jobs}) > 1 else set()


def short_setting(overrides: Sequence[str], shared: set[str]) -> str:
    """The overrides that not every job has, for a table or a sentence."""
    return " ".join(override for override in overrides if override not in shared and changes_result(override)) or "(as it comes)"


def overrides_alone(overrides: Sequence[str]) -> tuple[str, ...]:
    """The overrides that train a job alone, also where they name a page that makes a sweep of every command."""
    return (*overrides, *(["hydra.mode=RUN"] if any(overridden(override) == "sweep" for override in overrides) else []))


def settled_rows(jobs: Sequence[Job], target: Target) -> list[Row]:
    """The rows of which every seed has finished: one lucky seed settles nothing."""
    unsettled = {job.setting for job in jobs if job.result is None}
    return [row for row in rows_of(jobs, target) if row.setting not in unsettled]


def smallest_settled(jobs: Sequence[Job], target: Target) -> Row | None:
    """The smallest settled row within the target, of equal ones the more accurate."""
    return next((row for row in settled_rows(jobs, target) if row.is_within_target), None)


def knee_of(jobs: Sequence[Job], target: Target) -> Row | None:
    """The settled row after which more size buys less and less."""
    rows = settled_rows(jobs, target)
    place = knee([(row.error(target), row.size(target)) for row in rows])
    return None if place is None else rows[place]


def _row(setting: tuple[str, ...], seeds: Sequence[Job], target: Target) -> Row:
    results = [job.result for job in seeds if job.result is not None]
    # A frame without a surface makes an error infinite, which JSON holds as null.
    errors = {name: [math.inf if result[name] is None else float(result[name]) for result in results] for name in ("chamfer_l1_mm_mean", "chamfer_l1_mm_worst")}
    allowed = [most for most in map(target.allowed, results) if most is not None]
    by_error = sorted(range(len(results)), key=lambda place: errors[target.metric][place])
    middle = by_error[(len(by_error) - 1) // 2]
    return Row(
        setting=setting,
        overrides=seeds[middle].overrides,
        seeds=len(results),
        decoder_parameters=int(results[0]["decoder_parameters"]),
        query_bytes=int(results[0]["query_bytes"]),
        chamfer_l1_mm_mean=statistics.median(errors["chamfer_l1_mm_mean"]),
        chamfer_l1_mm_mean_range=(min(errors["chamfer_l1_mm_mean"]), max(errors["chamfer_l1_mm_mean"])),
        chamfer_l1_mm_worst=statistics.median(errors["chamfer_l1_mm_worst"]),
        chamfer_l1_mm_worst_range=(min(errors["chamfer_l1_mm_worst"]), max(errors["chamfer_l1_mm_worst"])),
        train_seconds=statistics.median(float(result["train_seconds"]) for result in results),
        threads=results[middle].get("threads"),
        is_within_target=len(allowed) == len(results) and statistics.median(errors[target.metric]) <= statistics.median(allowed),
    )


def _contents(path: Path) -> dict[str, Any] | None:
    """What a JSON file holds; None where it is missing or broken."""
    try:
        contents: dict[str, Any] = json.loads(path.read_text())
    except (FileNotFoundError, ValueError):
        return None
    return contents
