"""Starts Warp without a word on standard error."""

import logging
import os
import tempfile
from functools import cache

import warp as wp

logger = logging.getLogger(__name__)

wp.config.log_level = wp.LOG_ERROR  # its greeting is no news


@cache
def start_warp() -> None:
    """Start Warp once, before anything is asked of it.

    Its native code prints about a CUDA driver that is missing or too old, which listens to no log level and is no matter
    to the CPU: for that moment file descriptor 2 leads elsewhere, and what was printed is logged for debugging. Asking
    for a CUDA device that does not work raises an error of Warp's own as before.
    """
    with tempfile.TemporaryFile() as said:
        kept = os.dup(2)
        os.dup2(said.fileno(), 2)
        try:
            wp.init()
        finally:
            os.dup2(kept, 2)
            os.close(kept)
        said.seek(0)
        printed = said.read().decode(errors="replace").strip()
    if printed:
        logger.debug("Warp printed: %s", printed)
