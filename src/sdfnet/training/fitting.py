"""Letting Lightning run: what every fit of ours needs about it."""

import ctypes
import platform
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any

import torch
from lightning import Trainer
from lightning.pytorch.callbacks import Callback

from sdfnet.data.datamodule import ShapeFamily
from sdfnet.training.module import SdfTraining

MALLOC_OPTIONS = {-3: 1 << 30, -1: (1 << 31) - 1, -2: 64 << 20}  # M_MMAP_THRESHOLD, M_TRIM_THRESHOLD, M_TOP_PAD of malloc.h, bytes


def fit_quietly(
    module: SdfTraining, family: ShapeFamily, epochs: int, precision: str, callbacks: Sequence[Callback] = (), validate_every: int | None = None
) -> None:
    """Train on the CPU without logs, checkpoints or bars: for a measurement, or in a notebook.

    `validate_every` epochs there is a look at the validation loss, to which the paper's second plateau listens; never for None.
    """
    keep_freed_memory()
    validation_batches, every = (0, 1) if validate_every is None else (1, validate_every)
    trainer = Trainer(
        accelerator="cpu",
        precision=resolved_precision(precision, "cpu"),
        max_epochs=epochs,
        limit_val_batches=validation_batches,
        check_val_every_n_epoch=every,
        num_sanity_val_steps=0,
        log_every_n_steps=1,
        callbacks=list(callbacks),
        logger=False,
        enable_checkpointing=False,
        enable_progress_bar=False,
        enable_model_summary=False,
    )
    with steps_need_no_workers():
        trainer.fit(module, datamodule=family)


def resolved_precision(precision: str, accelerator: str) -> Any:
    """`precision`, and for auto bf16 where `accelerator` (auto, cpu or cuda) multiplies it in tiles, else float32.

    On two cores without tiles (AMX) the default's training took as long in both, 304 and 307 s, and float32 was the more accurate.
    """
    if precision != "auto":
        return precision
    is_on_gpu = accelerator != "cpu" and torch.cuda.is_available()
    return "bf16-mixed" if is_on_gpu or torch.cpu.get_capabilities().get("amx_bf16", False) else "32-true"


def keep_freed_memory() -> None:
    """Let glibc keep large freed blocks for the next step instead of giving them back and faulting every page in again."""
    if platform.libc_ver()[0] == "glibc":
        allocator = ctypes.CDLL(None)
        for option, size in MALLOC_OPTIONS.items():
            if not allocator.mallopt(option, size):  # an older glibc refuses so large a threshold; the others alone would only harm
                return


@contextmanager
def steps_need_no_workers() -> Iterator[None]:
    """Lightning advises more loader workers; steps are numbers, not files, and there is nothing for a worker to do."""
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*does not have many workers.*")
        warnings.filterwarnings("ignore", message=".*your dataloader is not resumable.*")  # nor anything to resume: a step is a pure function of its number
        warnings.filterwarnings("ignore", message=".*LeafSpec.*")  # inside Lightning 2.6
        yield
