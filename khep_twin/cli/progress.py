"""The command line's progress bar."""

import time
from collections.abc import Callable, Generator
from contextlib import contextmanager

from khep_twin.process.status_line import status_line

_BAR_WIDTH = 36


@contextmanager
def progress() -> Generator[Callable[[float], None] | None, None, None]:
    """Show a bar at the bottom of the terminal; show nothing if standard error is not a terminal.

    Yields a function that takes the finished share of the work, 0 to 1. The bar is erased at the end.
    """
    with status_line() as line:
        if line is None:
            yield None
            return
        start_s = time.monotonic()

        def show(share: float) -> None:
            elapsed = time.monotonic() - start_s
            bar = "#" * int(share * _BAR_WIDTH)
            eta = f"  {duration_text(elapsed * (1 - share) / share)} left" if share and elapsed > 1 else ""
            text = f"running  [{bar:-<{_BAR_WIDTH}}]  {share:4.0%}{eta}"
            if text != line.text:
                line.show(text)

        show(0.0)
        yield show


def part_bar(show: Callable[[float], None] | None, number: int, count: int) -> Callable[[float], None] | None:
    """Return a function that shows the finished share of part `number` (from 0) of `count` equal ones."""
    return None if show is None else lambda share: show((number + min(share, 1.0)) / count)


def duration_text(seconds: float) -> str:
    """Return a duration as hours:minutes:seconds."""
    total_s = round(seconds)
    return f"{total_s // 3600}:{total_s // 60 % 60:02}:{total_s % 60:02}"
