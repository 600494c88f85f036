"""`khep-twin serve` in a process of its own."""

import select
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def served(*arguments: str) -> Iterator[tuple["subprocess.Popen[str]", str]]:
    """`khep-twin serve`, and what a host opens."""
    command = [sys.executable, "-m", "khep_twin", "serve", *arguments]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
        try:
            assert process.stdout is not None
            assert select.select([process.stdout], [], [], 30)[0], "nothing was served"
            yield process, process.stdout.readline().strip()
        finally:
            process.kill()
