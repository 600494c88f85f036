"""The wire clock: hosts that poll without sleeping run fast, and the same each time."""

import sys
import time
from pathlib import Path

import pytest
import serial
from forked import run_python
from served_twin import ask, served

from khep_twin.log.reader import read_log

EXAMPLE = Path(__file__).parents[2] / "examples" / "01_braitenberg.py"


def drive(log: Path, cycles: int) -> None:
    """Runs the example's host on a twin by the wire clock."""
    with served("obstacles", "--clock", "wire", "--seed", "3", "--log", str(log)) as (_, path):
        assert run_python([sys.executable, str(EXAMPLE), path, str(cycles)], timeout=600).returncode == 0


@pytest.mark.share(2)
@pytest.mark.parametrize("cycles", [150, 1000])
def test_an_unmodified_host_takes_the_time_of_its_bytes_and_twice_the_same(
    cycles: int, tmp_path: Path
) -> None:
    logs = [tmp_path / "one.mcap", tmp_path / "two.mcap"]
    for log in logs:
        drive(log, cycles)
    one, two = (read_log(log).robots["khepera0"] for log in logs)
    assert one.serial == two.serial
    assert one.pose.tobytes() == two.pose.tobytes()
    assert len(one.serial) == 4 * cycles + 2
    # A host that asks again at once: no time passes but that of its bytes, eleven bits each. A request ends
    # with a line feed, a reply with two bytes. How fast that is on the wall is for `make bench`.
    n_bytes = sum(len(line.text) + 1 + (index % 2) for index, line in enumerate(one.serial))
    assert one.serial[-1].time_ns / 1e9 == pytest.approx(n_bytes * 11 / 9600, rel=1e-3)


def test_time_stands_still_while_no_host_sends(tmp_path: Path) -> None:
    log = tmp_path / "run.mcap"
    with (
        served("default", "--clock", "wire", "--log", str(log)) as (_, path),
        serial.Serial(path, 9600, stopbits=2, timeout=30) as port,
    ):
        assert ask(port, b"B\n") == b"b,5.02,5.01\r\n"
        time.sleep(0.2)
        assert ask(port, b"B\n") == b"b,5.02,5.01\r\n"
    times_ns = [line.time_ns for line in read_log(log).robots["khepera0"].serial]
    # Two bytes there and thirteen back, eleven bits each, twice.
    byte = 11 * 10**9 / 9600
    assert [round(time_ns / byte) for time_ns in times_ns] == [2, 15, 17, 30]
