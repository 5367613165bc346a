"""A sweep as a table and sentences for the screen, and as files."""

import csv
import json
import math
import shlex
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from rich.table import Table
from rich.text import Text

from sdfnet.cost.frontier import pareto_front
from sdfnet.cost.sweep_table import (
    JOB_COLUMNS,
    NOT_STARTED,
    Job,
    Row,
    Target,
    knee_of,
    overridden,
    overrides_alone,
    rows_of,
    shared_overrides,
    short_setting,
    smallest_settled,
)
from sdfnet.data.store import write_json, written_whole


def table_of(jobs: Sequence[Job], target: Target) -> Table:
    """The sweep as a table: a row for every setting of which a job finished."""
    rows = rows_of(jobs, target)
    shared = shared_overrides(jobs)
    front = pareto_front([(row.error(target), row.size(target)) for row in rows])
    smallest, bend = smallest_settled(jobs, target), knee_of(jobs, target)
    table = Table(
        title=f"chamfer L1, median over the seeds (lowest to highest); good enough: {target.words()}",
        caption="size: parameters of the decoder; kB: of all frames, as stored, latents included; s: of training",
        title_justify="left",
        caption_justify="left",
    )
    table.add_column("setting", overflow="fold", min_width=24)
    for heading in ("size", "kB", "mean, mm", "worst, mm", "s", "seeds"):
        table.add_column(heading, justify="right")
    for place, row in enumerate(rows):
        notes = [word for word, holds in (("smallest", row == smallest), ("knee", row == bend), ("front", place in front)) if holds]
        setting = short_setting(row.setting, shared) + (f"  <- {', '.join(notes)}" if notes else "")
        table.add_row(
            Text(setting),  # and not markup: lists stand in brackets
            f"{row.decoder_parameters:,}",
            f"{row.query_bytes / 1e3:.1f}",
            _spread(row.chamfer_l1_mm_mean, row.chamfer_l1_mm_mean_range),
            _spread(row.chamfer_l1_mm_worst, row.chamfer_l1_mm_worst_range),
            f"{row.train_seconds:.0f}",
            str(row.seeds),
        )
    return table


def sentences_of(jobs: Sequence[Job], target: Target) -> list[str]:
    """Every job that was started and did not finish, with its reason; then the smallest network that is good enough, the knee, and their commands."""
    rows, shared = rows_of(jobs, target), shared_overrides(jobs)
    bend = knee_of(jobs, target)
    sentences = [f"{job.status}: {short_setting(job.overrides, shared)}: {job.reason}" for job in jobs if job.result is None and job.status != NOT_STARTED]
    sentences += _answer(jobs, rows, target)
    if bend is not None:
        sentences.append(
            f"The knee is at {_size(bend, target)} ({_millimetres(bend.error(target))}): from there on more of them buy less. "
            f"{command_of(bend.overrides, bend.threads)}"
        )
    elif len(rows) > 2:
        sentences.append("There is no knee: of these, fewer than three are worth their size, or each step of size buys as much as the one before.")
    without = {short_setting(job.overrides, shared): job.result["failed_frames"] for job in jobs if job.result and job.result.get("failed_frames")}
    if without:
        found = ", ".join(f"{name} ({frames:.0f})" for name, frames in without.items())
        sentences.append(f"Without a surface in some frames: {found}; what each gives there is in its training.log.")
    return sentences + _mixtures([job.result for job in jobs if job.result is not None])


def _answer(jobs: Sequence[Job], rows: Sequence[Row], target: Target) -> list[str]:
    """The smallest network that is good enough and its command, or why there is none; and a smaller one of which seeds are missing."""
    results = [job.result for job in jobs if job.result is not None]
    smallest, possible = smallest_settled(jobs, target), next((row for row in rows if row.is_within_target), None)
    done = f"{len(results)} of {len(jobs)} jobs finished"
    if any(target.allowed(result) is None for result in results):
        return [f"{done}; KNN-1 has no surface in some frame, so there is nothing to be as good as: set target.chamfer_l1_mm."]
    if possible is None:
        nearest = min(rows, key=lambda row: row.error(target), default=None)
        best = "" if nearest is None else f"the best has {_millimetres(nearest.error(target))} with {_size(nearest, target)}"
        return [f"{done}; none is as good as {target.words()}: {best or 'no job finished'}."]
    if smallest is None:
        sentences = [f"{done}; of none that is as good as {target.words()} every seed finished."]
    else:
        sentences = [
            f"{done}. The smallest network as good as {target.words()} has {_size(smallest, target)}: "
            f"{smallest.chamfer_l1_mm_mean:.3f} mm mean, {smallest.chamfer_l1_mm_worst:.3f} mm in the worst frame.",
            f"Train it again: {command_of(smallest.overrides, smallest.threads)}",
        ]
    if possible != smallest:
        asked = sum(job.setting == possible.setting for job in jobs)
        name = short_setting(possible.setting, shared_overrides(jobs))
        sentences.append(f"{name} may do with {_size(possible, target)}: {possible.seeds} of {asked} seeds finished.")
    return sentences


def _mixtures(results: Sequence[dict[str, Any]]) -> list[str]:
    """What makes results differ though their settings do not: other versions, other files of the same dataset, other threads where seconds end a training."""
    sentences = []
    versions = {f"{name} {version}" for result in results for name, version in result.get("versions", {}).items()}
    several = sorted(one for one in versions if sum(other.split()[0] == one.split()[0] for other in versions) > 1)
    if several:
        sentences.append(f"The jobs ran with different versions, and may differ for that alone: {', '.join(several)}.")
    files: dict[str, set[str]] = {}
    for result in results:
        if "files" in result:
            files.setdefault(json.dumps(result["settings"]["dataset"], sort_keys=True), set()).add(result["files"]["distances"])
    remade = sorted(name for names in files.values() if len(names) > 1 for name in names)
    if remade:
        sentences.append(f"The jobs were trained on different files of the same dataset, and may differ for that alone: {', '.join(remade)}.")
    threads = sorted({result["threads"] for result in results if "threads" in result and result["settings"]["training"]["seconds"] is not None})
    if len(threads) > 1:
        sentences.append(f"Seconds end these trainings, and they had different threads, so that their steps differ: {', '.join(map(str, threads))}.")
    return sentences


def command_of(overrides: Sequence[str], threads: int | None = None) -> str:
    """The command line that trains a job alone, on as many threads as it had: on others a training of so many seconds takes other steps."""
    given = [] if threads is None or any(overridden(override) == "trainer.threads" for override in overrides) else [f"trainer.threads={threads}"]
    return shlex.join(["python", "train.py", *overrides_alone(overrides), *given])


def write_tables(sweep_folder: Path, jobs: Sequence[Job], target: Target) -> None:
    """Write `jobs.csv` (a line a job, failed ones with their reason) and `sweep.json` (the rows, the smallest and the knee)."""
    with written_whole(sweep_folder / "jobs.csv") as unfinished, unfinished.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["overrides", "status", "reason", *JOB_COLUMNS])
        for job in jobs:
            values = ["" if job.result is None else job.result.get(name, "") for name in JOB_COLUMNS]
            writer.writerow([" ".join(job.overrides), job.status, job.reason, *values])
    rows = rows_of(jobs, target)
    smallest, bend = smallest_settled(jobs, target), knee_of(jobs, target)
    contents = {
        "target": asdict(target),
        "rows": [asdict(row) | {"command": command_of(row.overrides, row.threads)} for row in rows],
        "smallest": None if smallest is None else command_of(smallest.overrides, smallest.threads),
        "knee": None if bend is None else command_of(bend.overrides, bend.threads),
    }
    write_json(sweep_folder / "sweep.json", contents)


def _spread(median: float, around: tuple[float, float]) -> str:
    middle, low, high = ("no surface" if value == math.inf else f"{value:.3f}" for value in (median, *around))
    return low if low == high else f"{middle} ({low} to {high})"


def _size(row: Row, target: Target) -> str:
    sizes = f"{row.decoder_parameters:,} parameters", f"{row.query_bytes / 1e3:.1f} kB with the latents"
    return ", ".join(sizes if target.size == "decoder_parameters" else reversed(sizes))


def _millimetres(error: float) -> str:
    return "no surface in some frame" if error == math.inf else f"{error:.3f} mm"
