"""Injected faults: their effects, probabilities and log messages."""

from typing import Any

import pytest
import serial
from notes import Notes

import khep_twin  # noqa: F401  (teaches pyserial khep://)
from khep_twin.board.fault_injection import MOTOR, SENSOR, WHEEL, parse_fault
from khep_twin.errors import FaultError
from khep_twin.interventions.move_robot import place_robot
from khep_twin.world import World


def open_with(fault: str, seed: int = 1) -> tuple[Any, Notes]:
    port = serial.serial_for_url(f"khep://default?seed={seed}&fault={fault}", timeout=0.5)
    notes = Notes()
    port.twin.world.observers.append(notes)
    return port, notes


def ask(port: Any, line: bytes) -> bytes:
    port.write(line + b"\n")
    return port.read_until(b"\n")


def test_a_fault_is_read_from_its_words() -> None:
    fault = parse_fault("late:0.1:60@2.5")
    assert (fault.kind, fault.probability, fault.delay_ns) == ("late", 0.1, 60_000_000)
    assert fault.start_ns == 2_500_000_000
    assert parse_fault("dead:right").which == 1
    fault = parse_fault("slip:right:0.25@1-2.5")
    assert (fault.device, fault.which, fault.part, fault.end_ns) == (WHEEL, 1, 0.25, 2_500_000_000)
    assert (parse_fault("dead:1").device, parse_fault("dead:right").device) == (SENSOR, MOTOR)


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("drob:0.1", "fault 'drob:0.1': unknown; did you mean 'drop'? (choices: drop, garble, late, stuck, "),
        ("drop", "fault 'drop': expected drop:PROBABILITY, such as drop:0.01, with @SECONDS or @FROM-TO"),
        ("drop:2", "fault 'drop:2': expected drop:PROBABILITY"),
        ("drop:nan", "fault 'drop:nan': expected drop:PROBABILITY"),
        ("late:0.1", "fault 'late:0.1': expected late:PROBABILITY:MILLISECONDS"),
        ("stuck:", "fault 'stuck:': expected stuck:SENSOR, its number or name, with @SECONDS"),
        (
            "stuck:8",
            "fault 'stuck:8': robot 0 is a Khepera; expected a number below 8, or a name; (choices: ",
        ),
        ("stuck:1.5", "fault 'stuck:1.5': robot 0 is a Khepera; expected a number below 8, or a name; (choi"),
        ("dead:", "fault 'dead:': expected dead:SENSOR, its number or name, dead:left or dead:right, with"),
        (
            "dead:both",
            "fault 'dead:both': robot 0 is a Khepera; expected left, right, a number below 8, or a",
        ),
        ("weak:left", "fault 'weak:left': expected weak:SIDE:PART, such as weak:left:0.5"),
        ("weak:2:0.5", "fault 'weak:2:0.5': expected weak:SIDE:PART"),
        ("slip:left:1.5", "fault 'slip:left:1.5': expected slip:SIDE:PART"),
        ("blocked:1", "fault 'blocked:1': expected blocked:left or blocked:right"),
        (
            "stuck:1@5-5",
            "fault 'stuck:1@5-5': expected stuck:SENSOR, its number or name, with @SECONDS or @FR",
        ),
        ("stuck:1@5-", "fault 'stuck:1@5-': expected stuck:SENSOR"),
        ("brown-out:1", "fault 'brown-out:1': expected brown-out alone"),
        ("brown-out@1-2", "fault 'brown-out@1-2': expected brown-out alone, with @SECONDS appended"),
        ("brown-out@-1", "fault 'brown-out@-1': expected brown-out alone"),
        ("", "fault '': unknown"),
    ],
)
def test_a_fault_that_there_is_not_is_refused(text: str, line: str) -> None:
    with pytest.raises(FaultError) as caught:
        World("default", faults=[parse_fault(text)])
    assert str(caught.value).startswith(line)


def test_dropped_bytes_are_missing_and_reported() -> None:
    port, notes = open_with("drop:0.05")
    replies = [ask(port, b"B") for _ in range(100)]
    good = replies.count(b"b,5.02,5.01\r\n")
    assert 20 < good < 80
    assert len(notes.events) > 50
    assert "dropped" in notes.events[0]


def test_garbled_bytes_have_one_bit_turned() -> None:
    port, notes = open_with("garble:1")
    port.write(b"B\n")
    port.read(100)
    assert "2 of b'B\\n' garbled" in notes.events[0]


def test_late_replies_are_late_by_what_is_asked() -> None:
    times = []
    for fault in ("late:0:60", "late:1:60"):
        port, _ = open_with(fault)
        start_ns = port.time_ns
        ask(port, b"B")
        times.append(port.time_ns - start_ns)
    assert times[1] - times[0] == 60_000_000


def test_a_stuck_sensor_reads_what_it_read_last() -> None:
    port, notes = open_with("stuck:2@1")
    port.sleep(1.1)
    readings = []
    for _ in range(30):
        readings.append([int(count) for count in ask(port, b"O").split(b",")[1:]])
    assert len({counts[2] for counts in readings}) == 1
    assert len({counts[3] for counts in readings}) > 5
    assert notes.events == ["fault stuck:2@1 begins"]


def test_a_dead_sensor_reads_nothing_and_the_highest_ambient_counts() -> None:
    port, notes = open_with("dead:2@0.5-1")
    place_robot(port.twin.world, 0, 570, 250, 0)
    port.sleep(0.1)
    notes.events.clear()
    counts = []
    for _ in range(3):
        near, light = (ask(port, command).split(b",")[1:] for command in (b"N", b"O"))
        counts.append((int(near[2]), int(near[3]), int(light[2])))
        port.sleep(0.5)
    before, during, after = counts
    assert during[0] == 0 < min(before[0], after[0], during[1])
    assert during[2] == 500
    assert notes.events == ["fault dead:2@0.5-1 begins", "fault dead:2@0.5-1 ends"]


@pytest.mark.parametrize("kind", ["dead:2", "stuck:2"])
def test_a_sensor_whose_fault_has_ended_reads_as_if_it_had_never_been(kind: str) -> None:
    registers = []
    for fault in ("drop:0", f"{kind}@0.2-0.4"):
        port, _ = open_with(fault)
        port.sleep(0.3)
        registers.append(port.twin.robot.registers.tolist())
        port.sleep(0.2)
        registers.append(port.twin.robot.registers.tolist())
    assert registers[0] != registers[2]
    assert registers[1] == registers[3]


def test_a_fault_of_the_line_ends() -> None:
    port, notes = open_with("drop:1@0.1-0.2")
    replies = []
    for _ in range(3):
        replies.append(ask(port, b"B"))
        port.sleep(max(0.0, 0.11 - port.time_ns / 1e9))
    assert replies == [b"b,5.02,5.01\r\n", b"", b"b,5.02,5.01\r\n"]
    assert [text for text in notes.events if "dropped" not in text] == [
        "fault drop:1@0.1-0.2 begins",
        "fault drop:1@0.1-0.2 ends",
    ]


def test_a_dead_motor_turns_freely_and_the_other_drives() -> None:
    port, notes = open_with("dead:left")
    ask(port, b"D,10,10")
    port.sleep(1)
    left, right = (int(count) for count in ask(port, b"H").split(b",")[1:])
    assert right > 800
    assert abs(left) < 200
    assert notes.events == ["fault dead:left begins"]


def test_a_brown_out_resets_the_board_once() -> None:
    port, notes = open_with("brown-out@0.5")
    assert ask(port, b"G,5,5") == b"g\r\n"
    port.sleep(1)
    assert port.read(200).startswith(b"ROM of minirobot KHEPERA")
    assert ask(port, b"H") == b"h,0,0\r\n"
    port.sleep(5)
    assert port.read(10) == b""
    assert notes.events == ["fault brown-out@0.5 begins"]


def test_the_same_seed_gives_the_same_faults_and_another_does_not() -> None:
    def talk(seed: int) -> list[bytes]:
        port, _ = open_with("drop:0.1,garble:0.05", seed)
        return [ask(port, b"B") for _ in range(20)]

    assert talk(1) == talk(1)
    assert talk(1) != talk(2)


def test_a_fault_on_the_line_leaves_the_sensors_rng_alone() -> None:
    counts = []
    for url in ("khep://default?seed=3", "khep://default?seed=3&fault=late:0.5:1"):
        port = serial.serial_for_url(url, timeout=1)
        port.sleep(1)
        counts.append(port.twin.robot.registers.tolist())
    assert counts[0] == counts[1]
