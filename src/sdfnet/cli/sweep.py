"""A sweep of trainings: each job in a process and a folder of its own, found again when the sweep is started again.

Hydra's sweeper makes the jobs and its launcher runs them, some at once. A job's own process can fail, run out of memory or
be killed: that is a row in the sweep's table, and the other jobs go on.
"""

import os
import sys
import traceback
from collections.abc import Callable, Collection, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from functools import partial
from itertools import count
from pathlib import Path
from types import FrameType

import joblib
import torch
from cloudpickle import register_pickle_by_value
from filelock import FileLock, Timeout
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from sdfnet.cli.earlier_run import last_checkpoint, quoted, typed
from sdfnet.cli.screen import screen
from sdfnet.cli.settings import TrainSettings
from sdfnet.cli.sweep_plan import folder_name, folder_of_sweep, planned_jobs, require_objectives
from sdfnet.cli.sweep_process import LOG_FILE, STOP_FILE, SWEEP_PROCESS, require_going_on, train_in_a_process
from sdfnet.cost.sweep_report import sentences_of, table_of, write_tables
from sdfnet.cost.sweep_table import (
    FAILED,
    FINISHED,
    JOB_FILE,
    LEFT_OUT,
    NOT_STARTED,
    RUNNING,
    Job,
    Target,
    read_job,
    read_jobs,
    read_plan,
    smallest_settled,
    unplanned,
    write_plan,
)
from sdfnet.data.prepare import prepare
from sdfnet.data.store import write_json
from sdfnet.errors import ConfigurationError, SdfnetError, TrainingError
from sdfnet.models.decoder import SdfCalculator
from sdfnet.models.networks import RECORD, read_checkpoint
from sdfnet.plugin_modules import PLUGIN_PACKAGE
from sdfnet.plugins import find_datasets, frozen
from sdfnet.stopping import Stopped, signals_handled

JOB_LOCK = ".{}.lock"  # beside the folder of a job that runs
LOCK_FILE = ".lock"  # in the folder of a sweep that runs
SET_ASIDE = "earlier"  # the folder in a sweep's for what jobs cannot go on with


def sweep(start: Callable[[], None], composed: DictConfig) -> None:
    """Let Hydra run the sweep in a folder that the same command finds again, then print its table; exit with 1 when a job did not finish.

    Raises ConfigurationError before the first job for a wrong target or objectives, a folder that is not known yet or that another sweep runs in, or values
    that cannot be tried one by one.
    """
    overrides, target = typed(), frozen(composed.target)
    folder = folder_of_sweep(composed, overrides)
    planned = planned_jobs(composed, overrides)
    require_objectives(composed, target)
    place = sys.argv.index(overrides[0]) + len(overrides) if overrides else len(sys.argv)
    sys.argv[place:place] = [f"hydra.sweep.dir={quoted(folder)}", "hydra.sweep.subdir=.", "hydra.output_subdir=null"]
    os.environ.pop(SWEEP_PROCESS, None)
    if "joblib" in composed.hydra.launcher._target_:  # whose processes are children of this one; another launcher's may be anyone's
        os.environ[SWEEP_PROCESS] = str(os.getpid())
    for name, module in list(sys.modules.items()):
        if name.startswith(PLUGIN_PACKAGE):
            register_pickle_by_value(module)  # a launcher's process has not loaded the plugins when the settings reach it
    with _alone_in(folder):
        write_plan(folder, None if planned is None else {folder_name(job): job for job in planned})
        given_up = [] if planned is not None else [job.folder for job in read_jobs(folder) if job.result is None]  # a search tries others
        try:
            with signals_handled(partial(_stop_jobs, folder)) if SWEEP_PROCESS in os.environ else nullcontext():
                start()
        finally:  # whatever ended it, what was finished is shown
            is_whole = finish(folder, target, given_up)
    if not is_whole:
        sys.exit(1)


@contextmanager
def _alone_in(folder: Path) -> Iterator[None]:
    """Keep other sweeps out of a folder, which is made, and forget that one was told to stop in it. Raises ConfigurationError where one runs."""
    folder.mkdir(parents=True, exist_ok=True)
    try:
        lock = FileLock(folder / LOCK_FILE).acquire(timeout=0)
    except Timeout as error:
        raise ConfigurationError(f"one sweep at a time can run in a folder, found one that runs in '{folder}'; wait for its end") from error
    with lock:
        (folder / STOP_FILE).unlink(missing_ok=True)
        yield


def _stop_jobs(folder: Path, number: int, frame: FrameType | None = None) -> None:
    """Have the trainings in a launcher's processes end with a checkpoint, for joblib would kill them; told again, do not wait. Raises Stopped."""
    if not (folder / STOP_FILE).exists():
        (folder / STOP_FILE).touch()
        screen().print("stopping: each training ends its step and writes a checkpoint; told again, the sweep does not wait for that")
        for lock in folder.glob(JOB_LOCK.format("*")):
            with FileLock(lock):
                pass
    raise Stopped(number)


def run_job(config: DictConfig) -> float | tuple[float, ...] | None:
    """Run one job in a process of its own, unless it is finished, and return what a sweeper minimises: None, as Optuna wants, for a job without it.

    A job that was stopped goes on from its last checkpoint. The cores are divided between the jobs that can run at once.
    """
    hydra_config = HydraConfig.get()
    overrides, sweep_folder = list(hydra_config.overrides.task), Path(hydra_config.sweep.dir)
    folder = sweep_folder / folder_name(overrides)
    folder.mkdir(parents=True, exist_ok=True)
    is_new = True
    with FileLock(folder.with_name(JOB_LOCK.format(folder.name))):
        require_going_on(sweep_folder)
        try:
            find_datasets()  # in a launcher's process nothing has loaded them, and their code is part of a job's key
            is_new = _run_if_needed(frozen(config), overrides, folder, _jobs_at_once(hydra_config.launcher.get("n_jobs", 1), sweep_folder))
        except Exception as error:  # of whatever kind: this job is a row with its reason, and the others go on
            reason = str(error)
            if not isinstance(error, SdfnetError):
                reason = f"{type(error).__name__}: {error}"
                with (folder / LOG_FILE).open("a") as log:
                    traceback.print_exc(file=log)
            earlier = read_job(folder)
            if earlier.result is None:
                _write_job(folder, overrides, earlier.configuration, FAILED, reason)
            else:  # refused before anything was touched, on another machine perhaps
                screen().print(f"{folder.name}: {reason}: what had finished is kept")
        job = read_job(folder)
    found = {name: (job.result or {}).get(name) for name in config.target.objectives}
    shown = ", ".join(f"{name} {'nothing' if value is None else f'{value:.4g}'}" for name, value in found.items()) if job.result else job.reason
    screen().print(f"{job.status}{'' if is_new else ' already'}: {' '.join(overrides)}: {shown}")
    values = tuple(float(value) for value in found.values() if value is not None)
    if len(values) < len(found):
        return None
    return values if len(values) > 1 else values[0]


def finish(sweep_folder: Path, target: Target, given_up: Collection[Path] = ()) -> bool:
    """Print and write the table of a sweep; whether it has jobs and all of them but those given up finished or were left out."""
    jobs, console = read_jobs(sweep_folder), screen()
    if all(job.status == NOT_STARTED for job in jobs):
        console.print(f"no job of the sweep began in '{sweep_folder}', so there is no table")
        return False
    write_tables(sweep_folder, jobs, target)
    if any(job.result is not None for job in jobs):
        console.print(table_of(jobs, target))
    console.print("\n".join(sentences_of(jobs, target)))
    others = unplanned(sweep_folder)
    if others:
        console.print(f"not counted, because this sweep does not ask for them: {', '.join(others)}")
    is_search = read_plan(sweep_folder) is None
    again = "tries more settings, and does not go on with one that was stopped" if is_search else "goes on with what is not finished"
    again += "" if is_search else f", and with more values and hydra.sweep.dir={quoted(sweep_folder)} trains only those"
    console.print(f"written to {sweep_folder}; the same command {again}")
    return all(job.status in (FINISHED, LEFT_OUT) or job.folder in given_up for job in jobs)


def _run_if_needed(settings: TrainSettings, overrides: Sequence[str], folder: Path, jobs_at_once: int) -> bool:
    """Whether there was something to do: what finished with the same settings is left as it is."""
    earlier = read_job(folder)
    if earlier.configuration == settings.key and earlier.status == FINISHED:
        return False
    outdated = _why_outdated(settings, earlier)
    if outdated is not None:  # before the new key is written: what lies beside a key was trained with it
        _set_aside(folder, outdated)
    hopeless = _why_hopeless(settings, folder.parent)
    if hopeless is not None:
        _write_job(folder, overrides, settings.key, LEFT_OUT, hopeless)
        return True
    _write_job(folder, overrides, settings.key, RUNNING)
    threads = max(1, joblib.cpu_count() // jobs_at_once) if settings.trainer.threads is None else settings.trainer.threads
    reason = train_in_a_process(folder, overrides, threads)
    _write_job(folder, overrides, settings.key, FINISHED if reason is None else FAILED, reason or "")
    return True


def _why_outdated(settings: TrainSettings, earlier: Job) -> str | None:
    """Why a job cannot go on with what its folder holds; None when it can, or when there is nothing."""
    checkpoint = last_checkpoint(earlier.folder)
    if earlier.configuration != settings.key:
        return None if checkpoint is None and earlier.result is None else "its settings differ from those that made it"
    if checkpoint is None:
        return None
    try:
        record = read_checkpoint(checkpoint)[RECORD]
    except TrainingError as error:
        return str(error)
    files = prepare(settings.dataset, Path(settings.data_folder))
    trained_on, there = (record["trajectory"], record["distances"]), (files.trajectory.name, files.distances.name)
    return None if trained_on == there else f"its data were made again since: {', '.join(trained_on)} then, {', '.join(there)} now"


def _set_aside(folder: Path, reason: str) -> None:
    kept = next(path for number in count(1) if not (path := folder.parent / SET_ASIDE / f"{folder.name}.{number}").exists())
    kept.parent.mkdir(exist_ok=True)
    folder.rename(kept)
    folder.mkdir()
    screen().print(f"{folder.name}: {reason}: trained anew; what was there is now in {kept}")


def _why_hopeless(settings: TrainSettings, sweep_folder: Path) -> str | None:
    """Why this job cannot become the smallest network within the target; None when it can, or when that is not asked."""
    if not settings.target.skip_larger:
        return None
    smallest = smallest_settled(read_jobs(sweep_folder), settings.target)
    decoder = SdfCalculator(settings.model, torch.zeros(3), torch.ones(3))
    in_bytes = settings.target.size == "query_bytes"  # of which the latents of all frames are a part that is not known before the data are
    size, unit = (decoder.stored_bytes(settings.evaluation.storage), "bytes") if in_bytes else (decoder.parameter_count, "parameters")
    if smallest is None or size <= smallest.size(settings.target):
        return None
    return f"its {size:,} {unit} are more than the {smallest.size(settings.target):,.0f} of a network that is good enough already (target.skip_larger)"


def _jobs_at_once(asked: int, sweep_folder: Path) -> int:
    """As joblib's launcher counts them, where -1 is one for each core; not more than a sweep has."""
    planned = read_plan(sweep_folder)
    allowed = asked if asked > 0 else joblib.cpu_count()
    return allowed if planned is None else min(allowed, len(planned))


def _write_job(folder: Path, overrides: Sequence[str], key: str, status: str, reason: str = "") -> None:
    write_json(folder / JOB_FILE, {"overrides": list(overrides), "configuration": key, "status": status, "reason": reason})
