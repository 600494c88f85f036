"""Latency of a velocity command of ROS 2, from its publisher to a robot's line: `python -m benchmarks.ros`.

A robot at a pseudo-terminal answers at once, so that the line itself takes no time. The floor is a line that
is written to that terminal. `khep-twin ros` runs in another process and is the router. The velocity changes
with each command, at moments that are independent of the node's cycle.
"""

import argparse
import os
import queue
import random
import socket
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Generator
from contextlib import ExitStack, contextmanager
from itertools import cycle

from benchmarks.line import open_terminal
from benchmarks.table import LEGEND, Row, RunTimes, Table, measure, text
from khep_twin.log.cdr import encode
from khep_twin.log.message_types import type_hash
from khep_twin.ros.graph import Graph
from khep_twin.ros.velocity import TWIST
from khep_twin.ros.wire import Attachment, data_key
from stand_ins.fake_robot import TerminalRobot

COMMANDS = 200
ROUNDS = 5
UNIT = "commands per s"
LIMIT = 30.0
"""Longest wait for a command [s]."""


class Arrivals(queue.SimpleQueue[float]):
    """Times at which commands of speeds arrived at a robot [s of `time.perf_counter`]."""

    def add(self, request: str) -> None:
        """Add the present time, if a line is a command of speeds."""
        if request.startswith("D"):
            self.put(time.perf_counter())


def median_latency(
    arrivals: Arrivals, send: Callable[[int], object], n_commands: int, latencies: list[float]
) -> RunTimes:
    """Send commands and return their median latency; `latencies` receives all of them [s]."""
    latencies.clear()
    moments = random.Random(1)
    for number in range(n_commands):
        time.sleep(moments.uniform(0, 0.06))
        while not arrivals.empty():
            arrivals.get()
        start = time.perf_counter()
        send(number)
        latencies.append(arrivals.get(timeout=LIMIT) - start)
    return RunTimes(statistics.median(latencies))


@contextmanager
def command_rows(n_commands: int) -> Generator[list[Row]]:
    """Measure commands to a robot at a pseudo-terminal, by the median latency of a round."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        router = f"127.0.0.1:{listener.getsockname()[1]}"
    floor_arrivals, arrivals = Arrivals(), Arrivals()
    with (
        TerminalRobot(floor_arrivals.add) as floor,
        TerminalRobot(arrivals.add) as robot,
        ExitStack() as stack,
    ):
        arguments = ["ros", robot.url, "--router", router, "--be-router", "--domain", "0", "--timeout", "60"]
        node = subprocess.Popen([sys.executable, "-m", "khep_twin", *arguments], stdout=subprocess.PIPE)
        stack.callback(node.wait)
        stack.callback(node.terminate)
        assert node.stdout is not None
        node.stdout.readline()  # its node is in the graph
        key = data_key(0, "/khepera0/cmd_vel", TWIST, type_hash(TWIST))
        port = open_terminal(floor.url)
        stack.callback(os.close, port)
        with Graph(router, 0) as graph:
            speeds = cycle((-0.08, 0.08))  # a node drops a command that repeats the last one

            def publish(number: int) -> None:
                speed = next(speeds)
                attachment = Attachment(number + 1, time.time_ns(), bytes(16)).to_bytes()
                graph.session.put(key, encode(TWIST, {"linear": {"x": speed}}), attachment=attachment)

            yield [
                _row(
                    "line to a pty (floor)", floor_arrivals, lambda _: os.write(port, b"D,1,1\n"), n_commands
                ),
                _row("cmd_vel to the line", arrivals, publish, n_commands),
            ]


def table(n_commands: int, rounds: int) -> Table:
    """Measure the latency of commands."""
    with command_rows(n_commands) as rows:
        return measure("velocity command of ROS 2", rows, rounds, unit=UNIT)


def _row(name: str, arrivals: Arrivals, send: Callable[[int], object], n_commands: int) -> Row:
    latencies: list[float] = []

    def note(_: float) -> str:
        p50, p99 = statistics.median(latencies), statistics.quantiles(latencies, n=100)[98]
        return f"p50 {1e3 * p50:.2f} ms, p99 {1e3 * p99:.2f} ms"

    return Row(name, 1, lambda: median_latency(arrivals, send, n_commands, latencies), note)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--commands", type=int, default=COMMANDS, help="commands of a round")
    options = parser.parse_args()
    print(f"{text([table(options.commands, ROUNDS)])}\n\n{LEGEND}")


if __name__ == "__main__":
    main()
