"""`khep-twin serve`, and other commands that serve, in their own processes."""

import select
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

LISTS_PORTS = (
    *(sys.executable, "-c"),
    "from serial.tools import list_ports; list_ports.comports = lambda: []\n"
    "from khep_twin.cli.app import main; main()",
    "ports",
)
"""`khep-twin ports` on a machine without serial ports, whatever is plugged into this one."""


@contextmanager
def served(
    *arguments: str, command: str = "serve", notices: bool = False
) -> Iterator[tuple["subprocess.Popen[str]", str]]:
    """`khep-twin serve`, or another one, and what a host opens; with notices in `stderr` if wanted."""
    words = [sys.executable, "-m", "khep_twin", command, *arguments]
    errors = subprocess.PIPE if notices else subprocess.DEVNULL
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=errors, text=True) as process:
        try:
            assert process.stdout is not None
            assert select.select([process.stdout], [], [], 120)[0], "nothing was served"
            yield process, process.stdout.readline().strip()
        finally:
            process.kill()
