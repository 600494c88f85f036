"""The command line's progress bar."""

import time
from collections.abc import Callable, Generator
from contextlib import contextmanager

from khep_twin.status_line import status_line

_WIDTH = 36


@contextmanager
def progress() -> Generator[Callable[[float], None] | None, None, None]:
    """Show a bar at the bottom of the terminal; nothing where standard error is not a terminal.

    Yields a function that takes the share of the work that is done, 0 to 1. The bar is erased at the end.
    """
    with status_line() as line:
        if line is None:
            yield None
            return
        begin = time.monotonic()

        def show(part: float) -> None:
            elapsed = time.monotonic() - begin
            bar = "#" * int(part * _WIDTH)
            left = f"  {clock(elapsed * (1 - part) / part)} left" if part and elapsed > 1 else ""
            text = f"running  [{bar:-<{_WIDTH}}]  {part:4.0%}{left}"
            if text != line.text:
                line.show(text)

        show(0.0)
        yield show


def of_part(show: Callable[[float], None] | None, number: int, count: int) -> Callable[[float], None] | None:
    """Return a function that shows the share done of one of `count` equal parts; None without a bar."""
    return None if show is None else lambda share: show((number + min(share, 1.0)) / count)


def clock(seconds: float) -> str:
    """Return a duration as hours:minutes:seconds."""
    whole = round(seconds)
    return f"{whole // 3600}:{whole // 60 % 60:02}:{whole % 60:02}"
