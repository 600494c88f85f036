"""`khep-twin serve`, and other commands that serve, in their own processes."""

import select
import signal
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from forked import Forked

LISTS_PORTS = (
    *(sys.executable, "-c"),
    "from serial.tools import list_ports; list_ports.comports = lambda: []\n"
    "from khep_twin.cli.app import main; main()",
    "ports",
)
"""`khep-twin ports` on a machine without serial ports, whatever is plugged into this one."""


@contextmanager
def served(
    *arguments: str,
    command: str = "serve",
    program: Sequence[str] = ("-m", "khep_twin"),
    pass_fds: tuple[int, ...] = (),
) -> Iterator[tuple["subprocess.Popen[str]", str]]:
    """`khep-twin serve`, or another one, and what a host opens, its first line."""
    process = Forked(
        [sys.executable, *program, command, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        pass_fds=pass_fds,
        text=True,
    )
    try:
        assert process.stdout is not None
        assert select.select([process.stdout], [], [], 120)[0], "nothing was served"
        yield process, process.stdout.readline().strip()
    finally:
        process.terminate()
        process.communicate(timeout=60)


def stop(process: "subprocess.Popen[str]", how: signal.Signals = signal.SIGTERM) -> tuple[int, str]:
    """Ends it; returns its exit code and what it said."""
    process.send_signal(how)
    _, errors = process.communicate(timeout=60)
    return process.returncode, errors
