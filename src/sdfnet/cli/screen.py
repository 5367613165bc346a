"""Where commands print their tables and sentences."""

import sys

from rich.console import Console

UNLIMITED = 1000  # columns, for output that goes into a file: a table takes those that it needs


def screen() -> Console:
    """A console whose sentences stay whole lines; in a file, tables do too."""
    return Console(highlight=False, soft_wrap=True, width=None if sys.stdout.isatty() else UNLIMITED)
