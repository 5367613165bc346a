"""Where commands print their tables and sentences."""

import sys

from rich.console import Console

UNLIMITED = 1000  # columns, for output that goes into a file: a table takes those that it needs


def screen() -> Console:
    """A console that prints brackets as they are and keeps sentences on their line; in a file, tables too."""
    return Console(highlight=False, markup=False, soft_wrap=True, width=None if sys.stdout.isatty() else UNLIMITED)
