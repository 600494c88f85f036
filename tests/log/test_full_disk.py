"""Full disks, files that may not grow, and descriptors that accept no bytes: the effects on a log."""

import errno
import os
import re
import resource
import select
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from io import BytesIO
from pathlib import Path

import pytest
from command_line import khep_twin
from driving import SECOND, drive
from forked import Forked, run_python
from log_contents import messages_of
from typer.testing import CliRunner

from khep_twin.cli.app import app
from khep_twin.errors import LogError
from khep_twin.log.batch_writer import BatchWriter
from khep_twin.log.line_recorder import LineRecorder
from khep_twin.log.log_file import PartFile
from khep_twin.log.reader import read_series
from khep_twin.log.recover import recover
from khep_twin.ports.twin import Twin, TwinOptions, open_twin

Start = Callable[[Path], Twin]

KHEP_TWIN = [sys.executable, "-m", "khep_twin"]
LIMITED = (
    "import resource, sys; resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv.pop(1)),) * 2); "
    "from khep_twin.cli.app import main; main()"
)
"""`khep-twin` whose files may not grow beyond the number of bytes in its first argument."""
MESSAGE = re.compile(
    r"the log cannot be written any more at (\d+\.\d\d) s: (.*); what came before is kept in "
)

mountable = pytest.mark.skipif(
    subprocess.run(
        ["/bin/sh", "-c", "unshare -rm mount -t tmpfs tmpfs /mnt"], capture_output=True, check=False
    ).returncode
    != 0,
    reason="no file system may be mounted here",
)


def end_of(part: Path) -> float:
    """Recovers a part; returns the time of its last sample [s]."""
    recovery = recover(part)
    assert recovery.is_complete
    return max(message.log_time for _, message in messages_of(recovery.path, "/tf")) / SECOND


def on_a_small_disk(folder: Path, size: str, words: Sequence[str]) -> subprocess.CompletedProcess[str]:
    """Run a command on a private small disk; copy its files to `folder`."""
    disk = folder / "disk"
    disk.mkdir()
    script = (
        'mount -t tmpfs -o size="$1" tmpfs "$2" || exit 99; disk="$2"; to="$3"; shift 3; "$@"; code=$?; '
        'cp "$disk"/* "$to"; exit $code'
    )
    command = ["unshare", "-rm", "/bin/sh", "-c", script, "sh", size, str(disk), str(folder), *words]
    return subprocess.run(command, capture_output=True, text=True, check=False)


@mountable
def test_a_run_on_a_full_disk_ends_with_one_line_and_what_was_written_is_rescued(tmp_path: Path) -> None:
    words = [*KHEP_TWIN, "run", "--seconds", "200", "--log", str(tmp_path / "disk" / "run.mcap")]
    process = on_a_small_disk(tmp_path, "200k", words)
    (line,) = [line for line in process.stderr.splitlines() if "khep-twin: " in line]
    assert process.returncode == 1, process
    assert (message := MESSAGE.search(line)), line
    assert message[2] == "No space left on device"
    # What a lock-step run had not written yet is at most five simulated seconds.
    assert float(message[1]) - 5 <= end_of(tmp_path / "run.mcap.part") <= float(message[1])


@mountable
def test_a_run_that_is_asked_to_carry_on_does_so_without_its_log(tmp_path: Path) -> None:
    log = tmp_path / "disk" / "run.mcap"
    words = [*KHEP_TWIN, "run", "--seconds", "30", "--log", str(log), "--ignore-log-errors"]
    process = on_a_small_disk(tmp_path, "200k", words)
    assert process.returncode == 3, process
    (line,) = [line for line in process.stderr.splitlines() if "khep-twin: " in line]
    assert line.endswith("run.mcap.part; the run goes on without it")
    assert re.search(r"^\d+ cycles in 30\.\d s$", process.stdout, re.MULTILINE), process
    assert "look at it" not in process.stdout
    assert end_of(tmp_path / "run.mcap.part") >= 4


def serve_until_it_is_full(log: Path, *options: str) -> tuple[subprocess.Popen[str], str]:
    """Serve a twin whose log may not grow far, and poll it until it reports that or ends."""
    words = ["serve", "default", "--noise", "off", "--log", str(log), *options]
    server = Forked(
        [sys.executable, "-c", LIMITED, "60000", *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert server.stdout is not None
    assert server.stderr is not None
    assert select.select([server.stdout], [], [], 60)[0], "nothing was served"
    port = os.open(server.stdout.readline().strip(), os.O_RDWR | os.O_NOCTTY)
    assert "; Ctrl-C ends it" in server.stderr.readline()
    end = time.monotonic() + 60
    while time.monotonic() < end and not select.select([server.stderr], [], [], 0.05)[0]:
        try:
            os.write(port, b"N\n")
            select.select([port], [], [], 1)
            os.read(port, 4096)
        except OSError as error:
            assert error.errno == errno.EIO, error  # noqa: PT017
            break  # it has ended since
    os.close(port)
    return server, server.stderr.readline()


def test_a_server_whose_log_may_not_grow_loses_at_most_a_second_and_ends(tmp_path: Path) -> None:
    server, line = serve_until_it_is_full(tmp_path / "run.mcap")
    _, rest = server.communicate(timeout=60)
    assert (server.returncode, rest) == (1, "")
    assert (message := MESSAGE.search(line)), line
    assert message[2] == "File too large"
    assert float(message[1]) - 1 <= end_of(tmp_path / "run.mcap.part") <= float(message[1])


@pytest.mark.long
def test_a_server_that_is_asked_to_carry_on_goes_on_answering(tmp_path: Path) -> None:
    link = tmp_path / "khepera"
    server, line = serve_until_it_is_full(tmp_path / "run.mcap", "--ignore-log-errors", "--link", str(link))
    assert line.endswith("; the run goes on without it\n")
    # What was written can be rescued while it goes on.
    assert end_of(tmp_path / "run.mcap.part") > 0
    port = os.open(link, os.O_RDWR | os.O_NOCTTY)
    os.write(port, b"B\n")
    reply = b""
    while not reply.endswith(b"b,5.02,5.01\r\n") and select.select([port], [], [], 5)[0]:
        reply += os.read(port, 4096)
    os.close(port)
    assert reply.endswith(b"b,5.02,5.01\r\n")
    server.terminate()
    _, rest = server.communicate(timeout=60)
    assert server.returncode == 3
    assert "cannot be written" not in rest


def test_a_controller_that_catches_everything_does_not_hide_it(tmp_path: Path) -> None:
    controller = tmp_path / "deaf.py"
    controller.write_text(
        "def controller(robot):\n    try:\n        robot.proximity()\n    except Exception:\n        pass\n"
    )
    log = tmp_path / "run.mcap"
    words = ["run", str(controller), "--seconds", "5000", "--log", str(log)]
    process = run_python([sys.executable, "-c", LIMITED, "45000", *words])
    assert process.returncode == 1, process
    assert MESSAGE.search(process.stderr.splitlines()[-1])
    assert "look at it" not in process.stdout


@pytest.mark.parametrize("command", ["run", "serve"])
def test_what_to_do_without_a_log_needs_a_log(command: str) -> None:
    result = CliRunner().invoke(app, [command, "--ignore-log-errors"])
    assert result.exit_code == 2
    assert result.stderr == (
        "khep-twin: --ignore-log-errors is about a log that fails; expected --log FILE.mcap with it\n"
    )


def test_a_device_is_no_place_for_a_log() -> None:
    process = khep_twin("run", "--seconds", "1", "--log", "/dev/full")
    assert process.returncode == 1
    (line,) = process.stderr.splitlines()
    assert line.startswith("khep-twin: /dev/full: cannot write a log here: this is no regular file")


def fill(twin: Twin) -> None:
    """Redirect the log's descriptor to a device that is always full."""
    assert twin.recorder is not None
    part = twin.recorder.part.resolve()
    (number,) = [
        int(entry.name)
        for entry in Path("/proc/self/fd").iterdir()
        if entry.is_symlink() and os.path.realpath(entry) == str(part)
    ]
    full = os.open("/dev/full", os.O_WRONLY)
    os.dup2(full, number)
    os.close(full)


def test_a_full_device_under_the_log_takes_nothing_of_what_is_there(tmp_path: Path, start: Start) -> None:
    twin = start(tmp_path / "run.mcap")
    drive(twin)
    twin.world.log_event(None, "still good")
    fill(twin)
    with pytest.raises(LogError, match="No space left on device"):
        twin.advance_to(20 * SECOND)
    assert end_of(tmp_path / "run.mcap.part") == 2


def test_a_log_that_fails_is_reported_once_and_the_run_is_the_same_without_it(
    tmp_path: Path, start: Start
) -> None:
    messages: list[str] = []
    twin = open_twin("obstacles", TwinOptions(seed=3))
    twin.record(tmp_path / "run.mcap", on_failure=messages.append)
    fill(twin)
    drive(twin, 6)
    twin.world.log_event(None, "after")
    twin.close()
    twin.close()
    (line,) = messages
    assert line.endswith("; the run goes on without it")
    assert twin.recorder is not None
    assert twin.recorder.failure is not None
    plain = open_twin("obstacles", TwinOptions(seed=3))
    drive(plain, 6)
    assert twin.world.data.qpos.tolist() == plain.world.data.qpos.tolist()


def test_a_relay_is_reported_once_too_and_no_other_file_gets_its_bytes(tmp_path: Path) -> None:
    messages: list[str] = []
    recorder = LineRecorder(
        tmp_path / "run.mcap", {"relay": "/dev/robot"}, lambda: 0, on_failure=messages.append
    )
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    size = (tmp_path / "run.mcap.part").stat().st_size
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        recorder.on_bytes(True, b"N\n")
        recorder.flush()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    other = tmp_path / "other.txt"
    with other.open("wb") as file:
        file.flush()
        recorder.on_bytes(False, b"n,1,2,3,4,5,6,7,8\r\n")
        recorder.on_event("too late")
        recorder.flush()
        recorder.close()
    assert len(messages) == 1
    assert other.read_bytes() == b""
    assert recorder.failure is not None


def test_a_file_that_was_closed_takes_nothing(tmp_path: Path) -> None:
    file = PartFile(tmp_path / "run.mcap.part")
    file.close()
    with (tmp_path / "other.txt").open("wb"), pytest.raises(OSError, match="Bad file descriptor"):
        file.write(b"too late")
    assert (tmp_path / "other.txt").read_bytes() == b""


class Failing(BytesIO):
    """A file that takes so many writes and no more."""

    def __init__(self, writes: int) -> None:
        super().__init__()
        self._left = writes

    def write(self, data: bytes) -> int:
        if not self._left:
            raise OSError(5, "Input/output error")
        self._left -= 1
        return super().write(data)


@pytest.mark.parametrize("writes", range(1, 8))
def test_wherever_a_file_fails_what_it_took_before_is_rescued(tmp_path: Path, writes: int) -> None:
    file = Failing(writes)
    written: list[int] = []
    with pytest.raises(OSError, match="Input/output error"):
        write(file, written)
    part = tmp_path / "run.mcap.part"
    part.write_bytes(file.getvalue())
    if writes == 1:
        with pytest.raises(LogError, match="nothing to rescue"):
            recover(part)
    else:
        recovery = recover(part)
        assert (recovery.n_messages, recovery.is_complete) == (len(written), True)


def write(file: Failing, written: list[int]) -> None:
    """Writes a log until the file fails, and notes which messages it has taken."""
    writer = BatchWriter(file, "ros2", "test")
    writer.attach("a.txt", "text")
    writer.describe("run", {"robots": "khepera0"})
    for time_ns in range(100):
        writer.add_lines(writer.channel("/a", "std_msgs/msg/String", "string data"), [time_ns], [b"\0\1\0\0"])
        writer.flush()
        written.append(time_ns)


def test_noise_with_the_digits_of_a_huge_number_does_not_end_the_recording_of_a_line(tmp_path: Path) -> None:
    log = tmp_path / "relay.mcap"
    recorder = LineRecorder(log, {}, lambda: 1000)
    for count in (b"9" * 400, b"9" * 30, b"17"):
        recorder.on_bytes(False, b"n,%b,2,3,4,5,6,7,8\r\n" % count)
    recorder.close()
    assert read_series(log).series["/khepera0/proximity"].values.tolist() == [[17, 2, 3, 4, 5, 6, 7, 8]]
