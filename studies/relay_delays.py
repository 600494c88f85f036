"""Delays of a real relay on a busy machine: `python -m studies relay-delays`.

Chunks are written to `serve --relay` in turn by a host and by a robot, some 20 ms apart, while endless loops
run. A delay is the time of a chunk in the relay's log less that of its writing; the smallest one counts as 0.
`stand_ins.line_times` draws delays of this shape.
"""

import os
import random
import subprocess
import sys
import time
import tty
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from khep_twin.shadow.recording import read_recording
from stand_ins.served import served
from tools.command_table import command_line

QUANTILES = 0.5, 0.75, 0.9, 0.99, 1.0


def main() -> None:
    """Measure and print the delays."""
    parser = command_line(__doc__)
    parser.add_argument("--chunks", type=int, default=1500, help="chunks of each direction")
    parser.add_argument("--loops", type=int, default=4, help="endless loops beside the relay")
    options = parser.parse_args()
    robot, line = os.openpty()
    tty.setraw(line)
    written: dict[bool, list[int]] = {True: [], False: []}
    with ExitStack() as stack:
        log = Path(stack.enter_context(TemporaryDirectory())) / "line.mcap"
        for _ in range(options.loops):
            loop = stack.enter_context(subprocess.Popen([sys.executable, "-c", "while True: pass"]))
            stack.callback(loop.kill)
        with served("serve", "--relay", os.ttyname(line), "--link", f"{log}.tty", "--log", str(log)) as (
            _,
            path,
        ):
            host = os.open(path, os.O_RDWR | os.O_NOCTTY)
            tty.setraw(host)
            for _ in range(options.chunks):
                for to_robot, ends in ((True, (host, robot)), (False, (robot, host))):
                    time.sleep(random.uniform(0.005, 0.04))
                    written[to_robot].append(time.monotonic_ns())
                    os.write(ends[0], b"N\n" if to_robot else b"n,0,0,0,0,0,0,0,0\r\n")
                    while not os.read(ends[1], 100).endswith(b"\n"):
                        pass
            os.close(host)
        chunks = read_recording(log).chunks
    late = {
        to_robot: np.array([chunk.time_ns for chunk in chunks if chunk.to_robot == to_robot])
        - written[to_robot]
        for to_robot in written
    }
    min_delay = min(delays.min() for delays in late.values())
    for to_robot, values in late.items():
        quantiles = zip(QUANTILES, np.quantile(values - min_delay, QUANTILES) / 1e6, strict=True)
        cells = ", ".join(f"{100 * part:g} % {value:.2f} ms" for part, value in quantiles)
        print(f"{'to' if to_robot else 'from'} the robot: {cells}")
    for end in (robot, line):
        os.close(end)
