"""The main job over the serial line, and a served twin beside a bare pseudo-terminal that echoes.

`python -m benchmarks.ports` also prints the delay of replies at 9600 baud, and the speed of the wire's clock.
A round trip is that of `B` and its 13 bytes, with a plain client that calls os.write and os.read. Its floor
is a process that answers each line with 13 ready bytes and does nothing else.
"""

import os
import statistics
import subprocess
import sys
import time
import tty
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from benchmarks.table import LEGEND, Row, Taken, measure, text, timed
from khep_twin.host import Khepera
from khep_twin.lab.experiment.controllers import braitenberg
from khep_twin.lab.experiment.experiment import run

ROUNDS = 5
TRIPS = 1000
REPLY = b"b,5.02,5.01\r\n"
EXAMPLE = Path(__file__).parents[1] / "examples" / "01_braitenberg.py"


def line_row(
    name: str, playpen: str, seconds: float, log: Path | None = None, *, compiled: bool = True
) -> Row:
    """Run the main job through the serial line in this process, with its opening and closing."""
    url = f"khep://{playpen}?seed=1" + (f"&log={log}" if log else "")

    def drive() -> None:
        with Khepera(url) as robot:
            world = robot.port.twin.world
            world.change_over_at = None
            if compiled:
                world.compile()
            run(braitenberg, robot, seconds=seconds)

    return Row(name, seconds, timed(drive))


@contextmanager
def trip_rows(trips: int) -> Generator[list[Row]]:
    """Measure round trips over pseudo-terminals, while their processes run, by a round's median trip."""
    echo, path = _echo()
    with _served("--unpaced") as twin:
        try:
            ends = {"bare pty echo (floor)": path, "served twin, unpaced": _path_of(twin)}
            yield [_trip_row(name, end, trips) for name, end in ends.items()]
        finally:
            twin.terminate()
            echo.kill()
            echo.wait()


def _trip_row(name: str, path: str, trips: int) -> Row:
    return Row(
        name,
        1,
        lambda: Taken(statistics.median(_trips(path, trips))),
        lambda rate: f"p50 {1e6 / rate:.0f} us",
    )


def main() -> None:
    with trip_rows(TRIPS) as rows:
        print(text([measure("B over a pty", rows, ROUNDS, unit="round trips per s")]))
    print(LEGEND)
    print_lateness()
    with _served("--clock", "wire", playpen="obstacles") as twin:
        name, start = _path_of(twin), time.perf_counter()
        subprocess.run([sys.executable, str(EXAMPLE), name, "1000"], check=True)
        took = time.perf_counter() - start
        twin.terminate()
        said = twin.communicate()[1]
    simulated = float(said.split(" s served")[0].split()[-1])
    factor = simulated / took
    print(f"wire clock, 1000 cycles of the example: {simulated:.1f} s in {took:.2f} s, {factor:.0f} times")


def print_lateness(queries: int = 400) -> None:
    """Print the delays of replies to N at 9600 baud, of a served twin and of a bare loop in turn."""
    echo, path = _echo(_PACED_ECHO)
    with _served() as twin:
        try:
            ends = {"bare paced echo (floor)": path, "served twin": _path_of(twin)}
            ports = {name: os.open(end, os.O_RDWR | os.O_NOCTTY) for name, end in ends.items()}
            late: dict[str, list[float]] = {name: [] for name in ports}
            for number in range(queries):
                for name, port in ports.items():
                    late[name].append(_late(port) * 1e3)
                    time.sleep(0.001 * (number % 7))
        finally:
            twin.terminate()
            echo.kill()
            echo.wait()
    print(f"N at 9600 baud, {queries} times each: beside the line's time the reply ends")
    for name, values in late.items():
        p99 = statistics.quantiles(values, n=100)[98]
        print(
            f"  {name:26} {statistics.median(values):+.2f} ms p50, {p99:+.2f} ms p99, "
            f"{max(values):+.2f} ms at most, {min(values):+.2f} ms at the earliest"
        )


_ECHO = """
import os, sys
master = int(sys.argv[1])
while True:
    if b"\\n" in os.read(master, 100):
        os.write(master, b"b,5.02,5.01\\r\\n")
"""

_PACED_ECHO = """
import os, sys, time
master, byte = int(sys.argv[1]), 11 / 9600
while True:
    if b"\\n" in os.read(master, 100):
        end = time.perf_counter() + 2 * byte
        for value in b"n,0,0,0,0,0,0,0,0\\r\\n":
            end += byte
            time.sleep(max(end - time.perf_counter(), 0))
            os.write(master, bytes([value]))
"""


def _echo(program: str = _ECHO) -> tuple[subprocess.Popen[bytes], str]:
    master, slave = os.openpty()
    tty.setraw(slave)
    command = [sys.executable, "-c", program, str(master)]
    return subprocess.Popen(command, pass_fds=[master]), os.ttyname(slave)


def _served(*options: str, playpen: str = "default") -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "khep_twin", "serve", playpen, *options]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def _path_of(process: subprocess.Popen[str]) -> str:
    assert process.stdout is not None
    return process.stdout.readline().strip()


def _trips(path: str, trips: int) -> list[float]:
    port = os.open(path, os.O_RDWR | os.O_NOCTTY)
    taken: list[float] = []
    try:
        for _ in range(trips):
            start, reply = time.perf_counter(), b""
            os.write(port, b"B\n")
            while len(reply) < len(REPLY):
                reply += os.read(port, 100)
            taken.append(time.perf_counter() - start)
    finally:
        os.close(port)
    time.sleep(0.1)
    return taken


def _late(port: int) -> float:
    """Return the delay of a reply to N beyond the line's time [s]."""
    start, reply = time.perf_counter(), b""
    os.write(port, b"N\n")
    while not reply.endswith(b"\n"):
        reply += os.read(port, 100)
    return time.perf_counter() - start - (2 + len(reply)) * 11 / 9600


if __name__ == "__main__":
    main()
