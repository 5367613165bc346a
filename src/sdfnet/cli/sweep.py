"""A sweep of trainings: each job in a process and a folder of its own, found again when the sweep is started again.

Hydra's sweeper makes the jobs and its launcher runs them, some at once. A job's own process can fail, run out of memory or
be killed: that is a row in the sweep's table, and the other jobs go on.
"""

import ctypes
import os
import signal
import subprocess
import sys
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path

import joblib
import torch
from cloudpickle import register_pickle_by_value
from filelock import FileLock
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from sdfnet.cli.earlier_run import typed
from sdfnet.cli.screen import screen
from sdfnet.cli.settings import TrainSettings
from sdfnet.cli.sweep_plan import folder_name, folder_of_sweep, planned_jobs, quoted
from sdfnet.cost.sweep_report import sentences_of, table_of, write_tables
from sdfnet.cost.sweep_table import (
    FAILED,
    FINISHED,
    JOB_FILE,
    LEFT_OUT,
    NOT_STARTED,
    RESULT_FILE,
    RUNNING,
    Target,
    read_job,
    read_jobs,
    smallest_settled,
    unplanned,
    write_plan,
)
from sdfnet.data.store import write_json
from sdfnet.errors import SdfnetError
from sdfnet.models.decoder import SdfCalculator
from sdfnet.plugin_modules import PLUGIN_PACKAGE
from sdfnet.plugins import find_datasets, frozen

LOG_FILE = "training.log"
REASON_LINES = 3  # of the log's end that are kept as a failed job's reason
PARENT_DIES = 1  # PR_SET_PDEATHSIG of Linux' prctl.h
SWEEP_PROCESS = "SDFNET_SWEEP_PROCESS"  # names in the environment the process with whose end its launcher's processes end


def sweep(start: Callable[[], None], composed: DictConfig) -> None:
    """Let Hydra run the sweep in a folder that the same command finds again, then print its table; exit with 1 when a job did not finish.

    Raises ConfigurationError before the first job for a wrong target, a folder that is not known yet, or values that cannot be tried one by one.
    """
    overrides, target = typed(), frozen(composed.target)
    folder = folder_of_sweep(composed, overrides)
    planned = planned_jobs(composed, overrides)
    write_plan(folder, None if planned is None else {folder_name(job): job for job in planned})
    place = sys.argv.index(overrides[0]) + len(overrides) if overrides else len(sys.argv)
    sys.argv[place:place] = [f"hydra.sweep.dir={quoted(folder)}", "hydra.sweep.subdir=.", "hydra.output_subdir=null"]
    os.environ.pop(SWEEP_PROCESS, None)
    if "joblib" in composed.hydra.launcher._target_:  # whose processes are children of this one; another launcher's may be anyone's
        os.environ[SWEEP_PROCESS] = str(os.getpid())
    for name, module in list(sys.modules.items()):
        if name.startswith(PLUGIN_PACKAGE):
            register_pickle_by_value(module)  # a launcher's process has not loaded the plugins when the settings reach it
    try:
        start()
    finally:  # whatever ended it, what was finished is shown
        is_whole = finish(folder, target)
    if not is_whole:
        sys.exit(1)


def run_job(config: DictConfig) -> float | tuple[float, ...] | None:
    """Run one job in a process of its own, unless it is finished, and return what a sweeper minimises: None, as Optuna wants, for a job without it.

    A job that was stopped goes on from its last checkpoint. The cores are divided between the jobs that run at once.
    """
    hydra_config = HydraConfig.get()
    overrides, sweep_folder = list(hydra_config.overrides.task), Path(hydra_config.sweep.dir)
    folder = sweep_folder / folder_name(overrides)
    folder.mkdir(parents=True, exist_ok=True)
    with FileLock(folder / "job.lock"):
        try:
            find_datasets()  # in a launcher's process nothing has loaded them, and their code is part of a job's key
            _run_if_needed(frozen(config), overrides, folder, _jobs_at_once(hydra_config.launcher.get("n_jobs", 1)))
        except Exception as error:  # of whatever kind: this job is a row with its reason, and the others go on
            reason = str(error)
            if not isinstance(error, SdfnetError):
                reason = f"{type(error).__name__}: {error}"
                with (folder / LOG_FILE).open("a") as log:
                    traceback.print_exc(file=log)
            _write_job(folder, overrides, read_job(folder).configuration, FAILED, reason)
        job = read_job(folder)
    found = {name: (job.result or {}).get(name) for name in config.target.objectives}
    shown = ", ".join(f"{name} {'nothing' if value is None else f'{value:.4g}'}" for name, value in found.items()) if job.result else job.reason
    screen().print(f"{job.status}: {' '.join(overrides)}: {shown}")
    values = tuple(float(value) for value in found.values() if value is not None)
    if len(values) < len(found):
        return None
    return values if len(values) > 1 else values[0]


def finish(sweep_folder: Path, target: Target) -> bool:
    """Print and write the table of a sweep; whether it has jobs and all of them finished or were left out."""
    jobs, console = read_jobs(sweep_folder), screen()
    if all(job.status == NOT_STARTED for job in jobs):
        console.print(f"no job of the sweep began in '{sweep_folder}', so there is no table")
        return False
    write_tables(sweep_folder, jobs, target)
    console.print(table_of(jobs, target))
    console.print("\n".join(sentences_of(jobs, target)))
    others = unplanned(sweep_folder)
    if others:
        console.print(f"not counted, because this sweep does not ask for them: {', '.join(others)}")
    console.print(f"written to {sweep_folder}; the same command goes on with what is not finished")
    return all(job.status in (FINISHED, LEFT_OUT) for job in jobs)


def _run_if_needed(settings: TrainSettings, overrides: Sequence[str], folder: Path, jobs_at_once: int) -> None:
    earlier = read_job(folder)
    is_same = earlier.configuration == settings.key
    if is_same and earlier.status == FINISHED:
        return
    if not is_same:  # before the new key is written: what lies beside a key was trained with it
        for checkpoint in ("latest.ckpt", "last.ckpt"):
            (folder / "checkpoints" / checkpoint).unlink(missing_ok=True)
    hopeless = _why_hopeless(settings, folder.parent)
    if hopeless is not None:
        _write_job(folder, overrides, settings.key, LEFT_OUT, hopeless)
        return
    _write_job(folder, overrides, settings.key, RUNNING)
    threads = settings.trainer.threads or max(1, joblib.cpu_count() // jobs_at_once)
    reason = _train_in_a_process(folder, overrides, threads, goes_on=is_same)
    _write_job(folder, overrides, settings.key, FINISHED if reason is None else FAILED, reason or "")


def _train_in_a_process(folder: Path, overrides: Sequence[str], threads: int, goes_on: bool) -> str | None:
    """None when it finished, else why it did not; it goes on from the last checkpoint if there is one of the same settings."""
    (folder / RESULT_FILE).unlink(missing_ok=True)
    checkpoint = folder / "checkpoints" / "latest.ckpt"
    arguments = [*overrides, "hydra.mode=RUN", f"hydra.run.dir={quoted(folder)}", f"trainer.threads={threads}", "trainer.progress_bar=false"]
    if goes_on and checkpoint.is_file():
        arguments.append(f"resume={quoted(checkpoint)}")
    command = [sys.executable, "-c", "from sdfnet.cli import train; train()", *arguments]
    with (folder / LOG_FILE).open("a") as log:
        log.write(f"goes on from {checkpoint}\n" if arguments[-1].startswith("resume=") else "")
        log.flush()
        # In a session of its own, Ctrl-C reaches it once, through the sweep; and it ends with the sweep, however that ends.
        process = subprocess.Popen(
            command,
            stdout=log,
            stderr=subprocess.STDOUT,
            env={**os.environ, "OMP_NUM_THREADS": str(threads)},
            start_new_session=True,
            preexec_fn=_end_with_parent,
        )
        try:
            while process.poll() is None:
                _wait(process)
        except BaseException:
            process.terminate()
            process.wait()
            raise
    if process.returncode == 0 and (folder / RESULT_FILE).is_file():
        return None
    return _reason(process.returncode, (folder / LOG_FILE).read_text(errors="replace"))


def _wait(process: subprocess.Popen[bytes]) -> None:
    """A second of waiting; in a launcher's process the end of it and of its job when the sweep that it works for is gone."""
    sweep_process = os.environ.get(SWEEP_PROCESS, str(os.getpid()))
    try:
        process.wait(1)
    except subprocess.TimeoutExpired:
        if sweep_process not in (str(os.getpid()), str(os.getppid())):
            process.terminate()
            process.wait()
            os._exit(1)  # nobody is left to raise to; a launcher's process would wait for its next job for ever


def _end_with_parent() -> None:
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PARENT_DIES, signal.SIGTERM)


def _reason(code: int, log: str) -> str:
    if code < 0:
        return f"killed by {signal.Signals(-code).name}" + (": out of memory?" if code == -signal.SIGKILL else "")
    lines = [line.strip() for line in log.splitlines() if line.strip() and "HYDRA_FULL_ERROR" not in line]
    return " ".join(lines[-REASON_LINES:]) or f"exit code {code} without a word"


def _why_hopeless(settings: TrainSettings, sweep_folder: Path) -> str | None:
    """Why this job cannot become the smallest network within the target; None when it can, or when that is not asked."""
    if not settings.target.skip_larger:
        return None
    smallest = smallest_settled(read_jobs(sweep_folder), settings.target)
    size = SdfCalculator(settings.model, torch.zeros(3), torch.ones(3)).parameter_count
    if smallest is None or size <= smallest.decoder_parameters:
        return None
    return f"its {size:,} parameters are more than the {smallest.decoder_parameters:,} of a network that is good enough already (target.skip_larger)"


def _jobs_at_once(asked: int) -> int:
    """Of joblib's launcher, where -1 is one for each core."""
    return asked if asked > 0 else joblib.cpu_count()


def _write_job(folder: Path, overrides: Sequence[str], key: str, status: str, reason: str = "") -> None:
    write_json(folder / JOB_FILE, {"overrides": list(overrides), "configuration": key, "status": status, "reason": reason})
