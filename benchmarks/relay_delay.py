"""Delay of a relay with and without a shadow: `python -m benchmarks.relay_delay`.

Three served twins at 9600 baud stand in for robots, two behind `serve --relay`, one behind `shadow --relay`.
A host asks `N` and sets speeds at each of them in turn. The difference between the two relays is the noise of
the measurement. The delay is the duration of a round trip less the time of its bytes on the line. The
shadow's processor time is also printed, as a share of the elapsed time.
"""

import argparse
import os
import statistics
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path

from benchmarks.line import delay_s, open_terminal, processor_s
from stand_ins.served import served

PLAYPEN = "obstacles"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--trips", type=int, default=500, help="round trips of N by each path")
    parser.add_argument("--particles", type=int, default=1000, help="particles of the shadow")
    options = parser.parse_args()
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        twins = [
            stack.enter_context(served("serve", PLAYPEN, "--link", str(folder / f"robot{seed}")))
            for seed in range(3)
        ]
        ways = {
            "relay": stack.enter_context(served("serve", "--relay", twins[0][1])),
            "another relay": stack.enter_context(served("serve", "--relay", twins[2][1])),
            "relay and shadow": stack.enter_context(
                served("shadow", PLAYPEN, "--relay", twins[1][1], f"--particles={options.particles}")
            ),
        }
        ports = {name: open_terminal(path) for name, (_, path) in ways.items()}
        shadow = _child_of(ways["relay and shadow"][0].pid)
        begin, used = time.monotonic(), processor_s(shadow)
        late: dict[str, list[float]] = {name: [] for name in ports}
        for number in range(options.trips):
            speed = 4 if number // 50 % 2 else -4
            for name, port in ports.items():
                late[name].append(1e3 * delay_s(port, b"N\n"))
                delay_s(port, b"D,%d,%d\n" % (speed, 4))
        part = (processor_s(shadow) - used) / (time.monotonic() - begin)
        for port in ports.values():
            os.close(port)
    for name, values in late.items():
        print(
            f"{name:18} {statistics.median(values):+.2f} ms p50, "
            f"{statistics.quantiles(values, n=100)[98]:+.2f} ms p99, {max(values):+.2f} ms at most"
        )
    print(f"the shadow of {options.particles} particles used {part:.2f} of a core")


def _child_of(pid: int) -> int:
    return int(Path(f"/proc/{pid}/task/{pid}/children").read_text().split()[0])


if __name__ == "__main__":
    main()
