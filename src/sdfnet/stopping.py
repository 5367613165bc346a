"""How a command ends when it is told to stop: by Ctrl-C, or by the SIGTERM of a scheduler."""

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType

SIGNALS = (signal.SIGINT, signal.SIGTERM)


class Stopped(BaseException):
    """A run was told to stop. Not an Exception: whoever goes on after an error must not go on after this."""

    def __init__(self, number: int) -> None:
        super().__init__(signal.Signals(number).name)
        self.exit_code = 128 + number  # 130 and 143: what a shell reports of a program that the signal ended


def stop(number: int, frame: FrameType | None = None) -> None:
    """A signal handler that stops at once. Raises Stopped."""
    raise Stopped(number)


@contextmanager
def signals_handled(handler: Callable[[int, FrameType | None], None] = stop) -> Iterator[None]:
    """Hand Ctrl-C and SIGTERM to `handler`, and put back afterwards who had them before. Only for the main thread."""
    before = {number: signal.signal(number, handler) for number in SIGNALS}
    try:
        yield
    finally:
        for number, handled in before.items():
            signal.signal(number, handled)
