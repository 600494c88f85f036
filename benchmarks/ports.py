"""Benchmarks of the main job over the serial line, and of a served twin against a bare echo.

`python -m benchmarks.ports` also prints the delay of replies at 9600 baud, and the speed of the wire's clock.
A round trip is that of `B` and its 13 bytes, with a plain client that calls os.write and os.read. Its floor
is a process that answers each line with 13 constant bytes.
"""

import os
import statistics
import subprocess
import sys
import time
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from benchmarks.line import delay_s, open_terminal, trip_s
from benchmarks.table import LEGEND, Row, RunTimes, measure, text, timed
from khep_twin.host import Khepera
from khep_twin.lab.experiment.controllers import braitenberg
from khep_twin.lab.experiment.experiment import run
from stand_ins.echoes import echoes
from stand_ins.served import served

ROUNDS = 5
TRIPS = 1000
EXAMPLE = Path(__file__).parents[1] / "examples" / "01_braitenberg.py"


def line_row(
    name: str, playpen: str, seconds: float, log: Path | None = None, *, compiled: bool = True
) -> Row:
    """Run the main job through the serial line in this process, with its opening and closing."""
    url = f"khep://{playpen}?seed=1" + (f"&log={log}" if log else "")

    def drive() -> None:
        with Khepera(url) as robot:
            world = robot.port.twin.world
            world.code.switch_at = None
            if compiled:
                world.compile()
            run(braitenberg, robot, seconds=seconds)

    return Row(name, seconds, timed(drive))


@contextmanager
def trip_rows(trips: int) -> Generator[list[Row]]:
    """Measure round trips over pseudo-terminals, while their processes run, by the median trip of a round."""
    with echoes(paced=False) as (_, [echo]), served("serve", "default", "--unpaced") as (_, twin):
        ends = {"bare pty echo (floor)": echo, "served twin, unpaced": twin}
        yield [_trip_row(name, end, trips) for name, end in ends.items()]


def _trip_row(name: str, path: str, trips: int) -> Row:
    return Row(
        name,
        1,
        lambda: RunTimes(statistics.median(_trips(path, trips))),
        lambda rate: f"p50 {1e6 / rate:.0f} us",
    )


def main() -> None:
    with trip_rows(TRIPS) as rows:
        print(text([measure("B over a pty", rows, ROUNDS, unit="round trips per s")]))
    print(LEGEND)
    print_lateness()
    with served("serve", "obstacles", "--clock", "wire") as (twin, name):
        start = time.perf_counter()
        subprocess.run([sys.executable, str(EXAMPLE), name, "1000"], check=True)
        took = time.perf_counter() - start
        twin.terminate()
        stderr = twin.communicate()[1]
    simulated = float(stderr.split(" s served")[0].split()[-1])
    factor = simulated / took
    print(f"wire clock, 1000 cycles of the example: {simulated:.1f} s in {took:.2f} s, {factor:.0f} times")


def print_lateness(queries: int = 400) -> None:
    """Print the delays of replies to N at 9600 baud, of a served twin and of a bare loop in turn."""
    with echoes() as (_, [echo]), served("serve", "default") as (_, twin):
        ports = {"bare paced echo (floor)": open_terminal(echo), "served twin": open_terminal(twin)}
        late: dict[str, list[float]] = {name: [] for name in ports}
        for number in range(queries):
            for name, port in ports.items():
                late[name].append(delay_s(port, b"N\n") * 1e3)
                time.sleep(0.001 * (number % 7))
        for port in ports.values():
            os.close(port)
    print(f"N at 9600 baud, {queries} times each: beside the line's time the reply ends")
    for name, values in late.items():
        p99 = statistics.quantiles(values, n=100)[98]
        print(
            f"  {name:26} {statistics.median(values):+.2f} ms p50, {p99:+.2f} ms p99, "
            f"{max(values):+.2f} ms at most, {min(values):+.2f} ms at the earliest"
        )


def _trips(path: str, trips: int) -> list[float]:
    port = open_terminal(path)
    try:
        durations = [trip_s(port, b"B\n")[0] for _ in range(trips)]
    finally:
        os.close(port)
    time.sleep(0.1)
    return durations


if __name__ == "__main__":
    main()
