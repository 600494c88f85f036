"""`khep-twin serve`, and other commands that serve, in their own processes."""

import signal
import subprocess
import sys
from collections.abc import Sequence
from contextlib import AbstractContextManager

from forked import Forked

import stand_ins.served

LISTS_PORTS = (
    *(sys.executable, "-c"),
    "from serial.tools import list_ports; list_ports.comports = lambda: []\n"
    "from khep_twin.cli.app import main; main()",
    "ports",
)
"""`khep-twin ports` on a machine without serial ports, whatever is plugged into this one."""


def served(
    *arguments: str,
    command: str = "serve",
    program: Sequence[str] = ("-m", "khep_twin"),
    pass_fds: tuple[int, ...] = (),
) -> AbstractContextManager[tuple["subprocess.Popen[str]", str]]:
    """`khep-twin serve`, or another one, and what a host opens, its first line."""
    return stand_ins.served.served(command, *arguments, program=program, start=Forked, pass_fds=pass_fds)


def stop(process: "subprocess.Popen[str]", how: signal.Signals = signal.SIGTERM) -> tuple[int, str]:
    """Ends it; returns its exit code and what it said."""
    process.send_signal(how)
    _, errors = process.communicate(timeout=60)
    return process.returncode, errors
