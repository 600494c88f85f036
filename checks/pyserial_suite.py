"""pyserial's test scripts that open a port, run on a looped-back line of the twin.

    python -m checks pyserial

The scripts come from pyserial's source archive, whose hash is pinned. They expect a plug that joins TX with
RX, RTS with CTS and DTR with DSR. `khep-twin serve --relay` to a terminal that echoes its input takes the
place of that plug for the data wires.
Tests that no pseudo-terminal can pass are listed in EXPECTED_FAILURES. Each other failure is an error, and so
is a success of a listed test.
"""

import importlib.util
import subprocess
import sys
import tarfile
import tempfile
import unittest
from pathlib import Path

from stand_ins.echoes import loopback
from stand_ins.served import served
from tools.command_table import command_line

SOURCE = "pyserial==3.5 --hash=sha256:3c77e014170dfffbd816e6ffc205e9842efb10be9f58ec16d3e8675b4925cddb\n"

SCRIPTS = [
    "test",
    "test_advanced",
    "test_cancel",
    "test_exclusive",
    "test_high_load",
    "test_iolib",
    "test_readline",
    "test_rs485",
    "test_threaded",
]
"""Scripts that open the given port; found with strace."""

EXPECTED_FAILURES = {
    "test.Test0_DataWires.test1_RTS": "a pseudo-terminal has no modem lines",
    "test.Test0_DataWires.test2_DTR": "a pseudo-terminal has no modem lines",
    "test.Test0_DataWires.test3_RI": "a pseudo-terminal has no modem lines",
    "test_cancel.TestCancelWrite.test_cancel_once": "a pseudo-terminal takes bytes at any speed",
    "test_rs485.Test_RS485_class.test_RS485_class": "a pseudo-terminal has no RS-485 mode",
}


def unpack(folder: Path) -> Path:
    """Download pyserial's source archive from the package index; return the folder of the scripts."""
    (folder / "source.txt").write_text(SOURCE)
    command = [sys.executable, "-m", "pip", "download", "-q", "--disable-pip-version-check", "--no-deps"]
    command += ["--no-binary", ":all:", "--require-hashes", "-r", str(folder / "source.txt")]
    subprocess.run([*command, "-d", str(folder)], check=True)
    with tarfile.open(folder / "pyserial-3.5.tar.gz") as archive:
        archive.extractall(folder, filter="data")
    return folder / "pyserial-3.5" / "test"


def run(script: Path, port: str) -> tuple[int, set[str]]:
    """Run one script on a port; return the number of its tests, and the failed ones."""
    spec = importlib.util.spec_from_file_location(f"pyserial_{script.stem}", script)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    module.__dict__["PORT"] = port
    suite = unittest.defaultTestLoader.loadTestsFromModule(module)
    result = unittest.TextTestRunner(verbosity=0).run(suite)
    bad = {case.id() for case, _ in [*result.failures, *result.errors]}
    return result.testsRun, {name.removeprefix("pyserial_") for name in bad}


def main() -> int:
    """Run all scripts; return 0 if only known tests fail."""
    command_line(__doc__).parse_args()
    count, failed = 0, set[str]()
    with tempfile.TemporaryDirectory() as folder, loopback() as device:
        scripts = unpack(Path(folder))
        with served("serve", "--relay", device) as (_, port):
            for name in SCRIPTS:
                tests, bad = run(scripts / f"{name}.py", port)
                count += tests
                failed |= bad
                print(f"{name:16} {tests} tests, {len(bad)} failed", flush=True)
    for name in sorted(failed - set(EXPECTED_FAILURES)):
        print(f"FAILED  {name}")
    for name in sorted(set(EXPECTED_FAILURES) - failed):
        print(f"PASSED, though known to fail  {name}")
    print(f"{count} tests, {len(failed)} failed, {len(EXPECTED_FAILURES)} known to")
    return int(failed != set(EXPECTED_FAILURES))
