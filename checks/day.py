"""Memory of a day of `serve --log` with a host that polls as fast as the line allows.

    python -m checks day 24 --log day.mcap
    python -m checks day 24 --seed 2            with a Khepera IV; 3: a Khepera III, 1: a Khepera

The server's loop runs on the wire clock over a pseudo-terminal. Its host is a separate process that sends 23
commands in each simulated second, as on the robot's line. The log is flushed each half of a simulated
second, as `serve` does each half second of wall time, so that it has as many chunks as in real time. The
exit status is 1 if the server's memory has grown beyond the limit.
"""

import os
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack, closing
from pathlib import Path
from types import SimpleNamespace

from khep_twin.cli.compile import compile_all
from khep_twin.clock import NS_PER_S
from khep_twin.ports import serve
from khep_twin.ports.pty import PtyPort
from khep_twin.ports.twin import TwinOptions, open_twin
from tools.command_table import command_line

MOST_GROWTH = 5.0
"""Limit of the growth in a day, after the first minute [MB]; proportional for a shorter run."""

HOUR_NS = 3600 * NS_PER_S
WARM_NS = 60 * NS_PER_S


def memory() -> float:
    """Return the memory of this process [MB]."""
    status = Path("/proc/self/status").read_text()
    return int(status.split("VmRSS:")[1].split()[0]) / 1000


def ask(path: str) -> None:
    """Poll the sensors repeatedly."""
    port = os.open(path, os.O_RDWR | os.O_NOCTTY)
    while True:
        os.write(port, b"N\n")
        reply = b""
        while b"\n" not in reply:
            reply += os.read(port, 4096)


def day(hours: float, log: Path, seed: int) -> float:
    """Serve for so many simulated hours; return the growth of memory [MB]."""
    end_ns = round(hours * HOUR_NS)
    start_s, first, next_ns = time.monotonic(), 0.0, WARM_NS
    with ExitStack() as stack:
        compile_all(parts=["world"])
        twin = stack.enter_context(
            open_twin(("arena3", "obstacles", "arena4")[seed % 3], TwinOptions(seed=seed, log=str(log)))
        )
        twin.world.code.switch_if_ready()  # as `serve --clock wire` does
        port = stack.enter_context(closing(PtyPort(None, twin.robot.firmware.baud)))
        command = [sys.executable, "-m", "checks", "day", "--host", port.path]
        host = stack.enter_context(subprocess.Popen(command))
        stack.callback(host.kill)
        world = twin.world

        def stop() -> bool:
            nonlocal first, next_ns
            if world.time_ns >= next_ns:
                now = memory()
                first = first or now
                size, wall = (
                    log.with_name(f"{log.name}.part").stat().st_size / 1e6,
                    time.monotonic() - start_s,
                )
                print(
                    f"{world.time_ns / HOUR_NS:6.2f} h  {now:7.1f} MB  grown by {now - first:6.2f} MB  "
                    f"log {size:7.1f} MB  after {wall:5.0f} s",
                    flush=True,
                )
                next_ns = min((next_ns // HOUR_NS + 1) * HOUR_NS, end_ns) if next_ns < end_ns else 2 * end_ns
            return world.time_ns >= end_ns

        # Flush as often in simulated time as otherwise in wall time.
        serve.time = SimpleNamespace(monotonic_ns=lambda: world.time_ns)  # pyright: ignore
        serve.serve(twin, [port], serve.WIRE_SPEED, stop=stop, notify=print)
        grown = memory() - first
        start_s = time.monotonic()
    took, size = time.monotonic() - start_s, log.stat().st_size / 1e6
    print(f"closed in {took:.1f} s, {memory():.1f} MB then, log {size:.1f} MB")
    return grown


def main() -> int:
    """Run a day; return 1 if memory has grown beyond the limit."""
    parser = command_line(__doc__)
    parser.add_argument("hours", type=float, nargs="?", default=24.0)
    parser.add_argument("--log", type=Path)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--host")
    wish = parser.parse_args()
    if wish.host:
        ask(wish.host)
    with tempfile.TemporaryDirectory(prefix="khep-twin-day-") as folder:
        grown = day(wish.hours, wish.log or Path(folder) / "day.mcap", wish.seed)
    print(f"{grown:.2f} MB more than after the first minute")
    return 0 if grown <= MOST_GROWTH else 1
