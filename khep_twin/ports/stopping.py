"""The ways a process is asked to end, as a question to ask."""

import signal
from collections.abc import Callable, Generator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def stopping() -> Generator[Callable[[], bool], None, None]:
    """Says whether the process was asked to end, by SIGINT, SIGTERM or SIGHUP.

    Asked once, it is left to come to an end by itself; asked again by SIGINT, it is interrupted.
    """
    asked = False

    def ask(number: int, frame: FrameType | None) -> None:
        nonlocal asked
        if asked and number == signal.SIGINT:
            raise KeyboardInterrupt
        asked = True

    before = {number: signal.signal(number, ask) for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)}
    try:
        yield lambda: asked
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
