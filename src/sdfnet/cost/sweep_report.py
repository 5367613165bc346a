"""A sweep as a table and sentences for the screen, and as files."""

import csv
import math
import shlex
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

from rich.table import Table
from rich.text import Text

from sdfnet.cost.frontier import pareto_front
from sdfnet.cost.sweep_table import (
    JOB_COLUMNS,
    NOT_STARTED,
    Job,
    Target,
    knee_of,
    overrides_alone,
    rows_of,
    shared_overrides,
    short_setting,
    smallest_within,
)
from sdfnet.data.store import write_json, written_whole


def table_of(jobs: Sequence[Job], target: Target) -> Table:
    """The sweep as a table: a row for every setting of which a job finished."""
    rows = rows_of(jobs, target)
    shared = shared_overrides(jobs)
    front = pareto_front([(getattr(row, target.metric), float(row.decoder_parameters)) for row in rows])
    smallest, bend = smallest_within(rows), knee_of(rows, target)
    table = Table(
        title=f"chamfer L1, median over the seeds (lowest to highest); good enough: {target.words()}",
        caption="size: parameters of the decoder; kB: of all frames, latents included; s: of training",
        title_justify="left",
        caption_justify="left",
    )
    table.add_column("setting", overflow="fold", min_width=24)
    for heading in ("size", "kB", "mean, mm", "worst, mm", "s", "seeds"):
        table.add_column(heading, justify="right")
    for place, row in enumerate(rows):
        notes = [word for word, holds in (("smallest", row is smallest), ("knee", row is bend), ("front", place in front)) if holds]
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
    rows, results = rows_of(jobs, target), [job.result for job in jobs if job.result is not None]
    smallest, bend = smallest_within(rows), knee_of(rows, target)
    done = f"{len(results)} of {len(jobs)} jobs finished"
    if any(target.allowed(result) is None for result in results):
        sentences = [f"{done}; KNN-1 has no surface in some frame, so there is nothing to be as good as: set target.chamfer_l1_mm."]
    elif smallest is None:
        nearest = min(rows, key=lambda row: float(getattr(row, target.metric)), default=None)
        best = "" if nearest is None else f"the best has {_millimetres(getattr(nearest, target.metric))} with {nearest.decoder_parameters:,} parameters"
        sentences = [f"{done}; none is as good as {target.words()}: {best or 'no job finished'}."]
    else:
        sentences = [
            f"{done}. The smallest decoder as good as {target.words()} has {smallest.decoder_parameters:,} parameters, {smallest.query_bytes / 1e3:.1f} kB "
            f"with the latents: {smallest.chamfer_l1_mm_mean:.3f} mm mean, {smallest.chamfer_l1_mm_worst:.3f} mm in the worst frame.",
            f"Train it again: {command_of(smallest.overrides)}",
        ]
    if bend is not None:
        sentences.append(
            f"The knee is at {bend.decoder_parameters:,} parameters ({_millimetres(getattr(bend, target.metric))}): from there on more parameters buy less. "
            f"{command_of(bend.overrides)}"
        )
    versions = {f"{name} {version}" for result in results for name, version in result.get("versions", {}).items()}
    several = sorted(one for one in versions if sum(other.split()[0] == one.split()[0] for other in versions) > 1)
    if several:
        sentences.append(f"The jobs ran with different versions, and may differ for that alone: {', '.join(several)}.")
    shared = shared_overrides(jobs)
    return [
        f"{job.status}: {short_setting(job.overrides, shared)}: {job.reason}" for job in jobs if job.result is None and job.status != NOT_STARTED
    ] + sentences


def command_of(overrides: Sequence[str]) -> str:
    """The command line that trains a job alone."""
    return shlex.join(["python", "train.py", *overrides_alone(overrides)])


def write_tables(sweep_folder: Path, jobs: Sequence[Job], target: Target) -> None:
    """Write `jobs.csv` (a line a job, failed ones with their reason) and `sweep.json` (the rows, the smallest and the knee)."""
    with written_whole(sweep_folder / "jobs.csv") as unfinished, unfinished.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(["overrides", "status", "reason", *JOB_COLUMNS])
        for job in jobs:
            values = ["" if job.result is None else job.result.get(name, "") for name in JOB_COLUMNS]
            writer.writerow([" ".join(job.overrides), job.status, job.reason, *values])
    rows = rows_of(jobs, target)
    smallest, bend = smallest_within(rows), knee_of(rows, target)
    contents = {
        "target": asdict(target),
        "rows": [asdict(row) | {"command": command_of(row.overrides)} for row in rows],
        "smallest": None if smallest is None else command_of(smallest.overrides),
        "knee": None if bend is None else command_of(bend.overrides),
    }
    write_json(sweep_folder / "sweep.json", contents)


def _spread(median: float, around: tuple[float, float]) -> str:
    middle, low, high = ("no surface" if value == math.inf else f"{value:.3f}" for value in (median, *around))
    return low if low == high else f"{middle} ({low} to {high})"


def _millimetres(error: float) -> str:
    return "no surface in some frame" if error == math.inf else f"{error:.3f} mm"
