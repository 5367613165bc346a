"""One job of a sweep in a process of its own, which ends with the sweep, and why it did not finish."""

import ctypes
import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from sdfnet.cli.earlier_run import last_checkpoint, quoted
from sdfnet.cost.sweep_table import RESULT_FILE
from sdfnet.stopping import SIGNALS

LOG_FILE = "training.log"
REASON_LINES = 3  # of the log's end that are kept as a failed job's reason
HYDRA_BEGINS = "Error executing job with overrides"  # the line before an error
HYDRA_ENDS = "Set the environment variable HYDRA_FULL_ERROR"  # the line after it
STOP_FILE = ".stop"  # in the folder of a sweep that was told to stop
PARENT_DIES = 1  # PR_SET_PDEATHSIG of Linux' prctl.h
SWEEP_PROCESS = "SDFNET_SWEEP_PROCESS"  # names in the environment the process with whose end its launcher's processes end


def train_in_a_process(folder: Path, overrides: Sequence[str], threads: int) -> str | None:
    """None when it finished, else why it did not; it goes on from the last checkpoint if there is one."""
    (folder / RESULT_FILE).unlink(missing_ok=True)
    checkpoint = last_checkpoint(folder)
    arguments = [*overrides, "hydra.mode=RUN", f"hydra.run.dir={quoted(folder)}", f"trainer.threads={threads}", "trainer.progress_bar=false"]
    if checkpoint is not None:
        arguments.append(f"resume={quoted(checkpoint)}")
    command = [sys.executable, "-c", "from sdfnet.cli import train; train()", *arguments]
    with (folder / LOG_FILE).open("a") as log:
        before = log.tell()
        log.write("" if checkpoint is None else f"goes on from {checkpoint}\n")
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
                require_going_on(folder.parent)
        except BaseException:
            process.terminate()
            process.wait()
            raise
    if process.returncode == 0 and (folder / RESULT_FILE).is_file():
        return None
    return _reason(process.returncode, (folder / LOG_FILE).read_bytes()[before:].decode(errors="replace"))


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


def require_going_on(sweep_folder: Path) -> None:
    """Raise KeyboardInterrupt, which joblib can hand to the process of the sweep, where that was told to stop."""
    if (sweep_folder / STOP_FILE).exists():
        raise KeyboardInterrupt


def _end_with_parent() -> None:
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(PARENT_DIES, signal.SIGTERM)


def _reason(code: int, log: str) -> str:
    if code < 0:
        return f"killed by {signal.Signals(-code).name}" + (": out of memory?" if code == -signal.SIGKILL else "")
    if code - 128 in SIGNALS:
        return f"told to stop by {signal.Signals(code - 128).name}"
    lines = [line.strip() for line in log.splitlines() if line.strip() and not line.startswith(HYDRA_ENDS)]
    begins = max((place for place, line in enumerate(lines, 1) if line.startswith(HYDRA_BEGINS)), default=0)
    return " ".join(lines[begins:][-REASON_LINES:]) or f"exit code {code} without a word"
