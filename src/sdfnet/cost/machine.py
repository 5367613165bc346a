"""The machine that a study runs on: its processor, its cores, and how many of them a timing may use."""

import os
import platform
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import torch

from sdfnet.errors import ConfigurationError

CPU_FILE = Path("/proc/cpuinfo")


def machine() -> dict[str, str]:
    """What seconds depend on besides the code: the processor by name and the cores that this process may use."""
    lines = CPU_FILE.read_text().splitlines() if CPU_FILE.is_file() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return {"processor": names[0] if names else platform.processor() or platform.machine(), "cores": str(len(available_cores()))}


def available_cores() -> list[int]:
    """Numbers of the cores that this process may use."""
    return sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else list(range(os.cpu_count() or 1))


@contextmanager
def on_cores(count: int) -> Iterator[None]:
    """Bind this thread and those that it starts meanwhile to `count` cores, and PyTorch to as many threads; as it was afterwards.

    Threads that run already, such as those of PyTorch's pool, are not bound: on one core PyTorch uses none of them, on
    more it uses as many as are wanted, on cores of the system's choice. Raises ConfigurationError when there are fewer
    cores. Where the system cannot bind threads (macOS, Windows) only PyTorch is held.
    """
    allowed, threads = available_cores(), torch.get_num_threads()
    if count > len(allowed):
        raise ConfigurationError(f"a timing on {count} cores needs as many, found {len(allowed)}; ask for fewer")
    bind = getattr(os, "sched_setaffinity", lambda process, cores: None)
    bind(0, allowed[:count])
    torch.set_num_threads(count)
    try:
        yield
    finally:
        bind(0, allowed)
        torch.set_num_threads(threads)
