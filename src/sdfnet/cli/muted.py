"""Without the warnings of a part of sdfnet, where they have been said already or are meant."""

import logging
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def muted(*names: str) -> Iterator[None]:
    """Let these loggers report errors alone, and put back afterwards what they did before."""
    before = {name: logging.getLogger(name).level for name in names}
    for name in names:
        logging.getLogger(name).setLevel(logging.ERROR)
    try:
        yield
    finally:
        for name, level in before.items():
            logging.getLogger(name).setLevel(level)
