"""The command line's progress bar."""

import sys
from collections.abc import Callable, Generator
from contextlib import contextmanager

import typer


@contextmanager
def progress() -> Generator[Callable[[float], None] | None, None, None]:
    """A bar on the terminal, for runs of more than a second; nothing where nobody looks.

    Yields what is told the part that is done, 0 to 1.
    """
    if not sys.stderr.isatty():
        yield None
        return
    with typer.progressbar(length=1000, label="running", file=sys.stderr) as bar:

        def show(part: float) -> None:
            bar.update(int(part * 1000) - bar.pos)

        yield show
