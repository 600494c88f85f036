"""A computer of a model: its buses, empty messages, memory and files, as a program in C finds them."""

import os
import resource
from pathlib import Path

import pytest
from test_compiled_programs import pytestmark
from test_machine import BareRobot, Chip, StepClock

from khep_twin.errors import KhepTwinError
from khep_twin.programs.computer import PWM, Computer, Devices, Machine, i2c_bus
from khep_twin.programs.robot_program import RobotProgram, _write_files, run_programs  # type: ignore[reportPrivateUsage]

__all__ = ["pytestmark"]

BUS = i2c_bus(0, sends_empty=True)
COMPUTER = Computer(
    nodes={"/dev/i2c-0": BUS, "/dev/i2c/0": BUS, "/dev/i2c-1*": i2c_bus(127), "/dev/pwm": PWM},
    connect=lambda robot: robot.devices,
    files=lambda number: {"/etc/robot/number": f"{number}\n", "/etc/robot/names": ""},
    byte_ns=90_000,
    memory={0x40E00004: 1 << 8, 0x41300000: 0},
)


def machine_of(chips: dict[tuple[int, int], Chip], clock: StepClock) -> Machine:
    return Machine(BareRobot(Devices(chips), COMPUTER), clock)  # type: ignore[arg-type]


def test_a_program_finds_the_buses_memory_and_files_of_its_model(
    programs: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    chips, clock = {place: Chip() for place in ((0, 0x29), (0, 0x31), (127, 0x31))}, StepClock()
    assert run_programs([RobotProgram([str(programs / "buses")], machine_of(chips, clock), 5)]) == [0]
    assert capfd.readouterr().out.splitlines() == [
        "unknown -1 ?",
        "probe 1",
        "read probe 1",
        "nobody -1 ENXIO",
        "other bus -1 EINVAL",
        "slave 0",
        "quick 0",
        "other quick -1 EINVAL",
        "functions 1",
        "other functions 0",
        "write 3",
        "other write 2",
        "one shot 2",
        "content 9",
        "read 1",
        "content 7",
        "other read 1",
        "content 8",
        "pins 0x100 0",
        "again 0x100, clock 0",
        "robot 5, entries 4, none -1",
        "new 1, bytes 4",
        "beside -1",
    ]
    assert [chip.content for chip in chips.values()] == [b"\x09", b"\x07\x08\x09", b"\x08\x09"]
    # Six probes, five of them with an answer, then messages of 3, 2, 1, 1, 1 and 1 bytes and their addresses.
    assert clock.time_ns == 90_000 * (5 + 1 + 9 + 6)
    assert not os.path.exists("/etc/robot")


def test_each_robot_has_its_own_memory(programs: Path) -> None:
    clock = StepClock()
    commands = [[str(programs / "buses"), "own"]] * 2
    codes = run_programs(
        [RobotProgram(words, machine_of({}, clock), 7 + i) for i, words in enumerate(commands)]
    )
    assert (codes, clock.time_ns) == ([7, 8], 2_000_000)


def test_a_memory_that_no_file_can_hold_is_a_one_line_error(tmp_path: Path) -> None:
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))
    try:
        with pytest.raises(KhepTwinError, match=r"File too large; expected a folder in TMPDIR, and a limit"):
            _write_files(tmp_path, COMPUTER, 1)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
