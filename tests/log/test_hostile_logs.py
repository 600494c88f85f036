"""Forged logs: one line with the place, the value and the expectation, never a traceback."""

import json
import re
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command_line import khep_twin
from driving import SECOND
from log_rewriting import rewritten
from mcap.opcode import Opcode

from checks.fuzz.log_mutations import Record, assemble_log, parse_records
from khep_twin.board.uart import HostEvent, HostEventKind, LineSettings
from khep_twin.errors import KhepTwinError
from khep_twin.lab.conformance.recording.conform import conform_recording
from khep_twin.lab.experiment.repeat import repeat
from khep_twin.lab.experiment.replay_to_port import replay_to_port
from khep_twin.lab.report.report import make_report
from khep_twin.log.attached import compile_shapes
from khep_twin.log.cdr import CDR_HEADER, Encoder
from khep_twin.log.channels import (
    ArrayFrame,
    Level,
    LineFrame,
    TextLine,
    line_message,
)
from khep_twin.log.decoding import read_line
from khep_twin.log.host_events import events_message
from khep_twin.log.reader import Recording, read_arrays, read_end_ns, read_label, read_log, read_series
from khep_twin.log.recorded import read_recorded_run
from khep_twin.log.recover import recover as rescue
from khep_twin.log.viewer.replay import view
from khep_twin.ports.twin import TwinOptions, open_twin
from khep_twin.shadow.recording import read_recording

TIME_NS = 1_000_000_000


@pytest.fixture(scope="module")
def small(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of a fifth of a second."""
    path = tmp_path_factory.mktemp("log") / "small.mcap"
    with open_twin("obstacles", TwinOptions(seed=3, log=str(path))) as twin:
        twin.robot.send(b"D,8,5\n")
        twin.advance_to(SECOND // 5)
    return path


@pytest.fixture(scope="module")
def driven(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of a few exchanges."""
    path = tmp_path_factory.mktemp("log") / "driven.mcap"
    with open_twin("obstacles", TwinOptions(seed=3, log=str(path))) as twin:
        for command in (b"D,8,5\n", b"N\n", b"H\n", b"E\n"):
            twin.robot.send(command)
            twin.advance_to(twin.world.time_ns + SECOND // 10)
    return path


def integers(*numbers: int, label: str = "") -> bytes:
    values = np.array([numbers], np.int64)
    return ArrayFrame(len(numbers), "i8", label).messages(values)[0].tobytes()


def floats(*numbers: float) -> bytes:
    return ArrayFrame(len(numbers), "f8", "").messages(np.array([numbers]))[0].tobytes()


def instead(topic: str, data: bytes) -> Callable[[str, int, bytes], bytes]:
    return lambda message_topic, time_ns, before: data if message_topic == topic else before


def attached(name: str, content: bytes | None) -> Callable[[str, bytes], bytes | None]:
    """An attachment has another content, or is missing."""
    return lambda attachment, before: content if attachment == name else before


def error_line(use: Callable[[Path], object], path: Path) -> str:
    """The one line that comes of using a log."""
    with pytest.raises(KhepTwinError) as caught:
        use(path)
    line = str(caught.value)
    assert len(line.splitlines()) == 1, line
    assert line.startswith(f"{path}: "), line
    assert line.isprintable(), line
    return line


def again(path: Path) -> object:
    return repeat(read_recorded_run(path))


ACTS = {
    "a negative size": ((0, 0, 0, -1, -1, -6), r"size = -6 at number 0; expected 0 to 0"),
    "more bytes than there are": ((0, 0, 0, -1, -1, 3, 65, 10), r"size = 3 at number 0; expected 0 to 2"),
    "a size beyond all bounds": ((0, 0, 0, -1, -1, 2**62), r"size = 4611686018427387904 .*expected 0 to 0"),
    "half an event": ((0, 0, 0, -1, -1), "5 numbers at 0; expected 6 that begin an event"),
    "no byte": ((0, 0, 0, -1, -1, 1, 256), "byte = 256 after number 5; expected 0 to 255"),
    "a negative byte": ((0, 0, 0, -1, -1, 1, -1), "byte = -1 after number 5; expected 0 to 255"),
    "an unknown kind": ((0, 9, 0, -1, -1, 0), "kind = 9 at number 0; expected 0 to 8"),
    "a time before the run": ((-1, 0, 0, -1, -1, 0), "time = -1 at number 0; expected 0 to"),
    "a place of two bytes": ((0, 4, 0, -1, -1, 2, 1, 2), "size = 2 of kind 4 at number 0; expected 24 or 25"),
    "a switch of a byte": ((0, 5, 0, -1, -1, 1, 1), "size = 1 of kind 5 at number 0; expected 5 bytes"),
    "a speed beyond all bounds": ((0, 3, 0, 2**40, 1, 0), "baud = 1099511627776 at number 0; expected -1 to"),
    "three stop bits": ((0, 3, 0, 9600, 3, 0), "stop bits = 3 at number 0; expected -1 to 2"),
    "an event after years": ((2**62, 0, 0, -1, -1, 0), r"something at .* s; expected at most 10.20 s"),
}


@pytest.mark.parametrize("name", ACTS)
def test_host_events_that_cannot_be_are_refused_with_their_position(
    small: Path, tmp_path: Path, name: str
) -> None:
    numbers, expected = ACTS[name]
    path = rewritten(small, tmp_path / "x.mcap", instead("/khepera0/host_events", integers(*numbers)))
    line = error_line(again, path)
    assert "/host_events" in line
    assert re.search(expected, line), line


MESSAGES = {
    "/khepera0/proximity": floats(1, 2),
    "/khepera0/speed": floats(1, 2, 3, float("nan")),
    "/khepera0/duty": floats(1e300, 2),
    "/khepera0/registers": CDR_HEADER + struct.pack("<IIII", 0, 0, 2**32 - 1, 0),
    "/khepera0/ambient": CDR_HEADER + struct.pack("<I", 2**32 - 1),
    "/khepera0/serial": CDR_HEADER + struct.pack("<iIBxxxI", 0, 0, 20, 2**32 - 1),
    "/events": line_message(TextLine(0, Level.INFO, "x", "y")).replace(b"x", b"\xff"),
    "/khepera0/host_events": CDR_HEADER,
    "/state": b"",
    "/tf": Encoder().append("I", 2**32 - 1).message(),
}


@pytest.mark.parametrize("topic", MESSAGES)
def test_messages_of_a_wrong_shape_are_refused_with_their_position(
    small: Path, tmp_path: Path, topic: str
) -> None:
    path = rewritten(small, tmp_path / "x.mcap", instead(topic, MESSAGES[topic]))
    use = again if topic in ("/khepera0/host_events", "/state") else read_log
    if topic == "/events":
        with open_twin("obstacles", TwinOptions(log=str(tmp_path / "event.mcap"))) as twin:
            twin.world.log_event(0, "taken away")
        path = rewritten(tmp_path / "event.mcap", path, instead(topic, MESSAGES[topic]))
    line = error_line(use, path)
    assert line.startswith(f"{path}: {topic} at 0.0"), line
    assert "; expected " in line


@pytest.mark.parametrize("use", [read_log, read_series, read_recorded_run, read_arrays])
@pytest.mark.parametrize("data", [b"", b"\0", CDR_HEADER, bytes(3), b"\xff" * 40, CDR_HEADER + b"\xff" * 40])
def test_empty_and_foreign_messages_everywhere_are_one_line(
    small: Path, tmp_path: Path, use: Callable[[Path], object], data: bytes
) -> None:
    line = error_line(use, rewritten(small, tmp_path / "x.mcap", lambda topic, time_ns, before: data))
    assert "; expected " in line


NAMES = {
    "khepera0,khepera1": "khepera1/base in 0 of 11 messages; expected it in each",
    "": "robots = ; expected names with commas between",
    "khepera0,khepera0": "robots = khepera0,khepera0; expected each name once",
    ",".join(f"a{number}" for number in range(5000)): "expected names with commas between",
    "a\nb": r"robots = 'a\\nb'; expected",
    "../../x": "robots = ../../x; expected",
}


@pytest.mark.parametrize("names", NAMES)
def test_robots_that_are_not_there_are_refused(small: Path, tmp_path: Path, names: str) -> None:
    path = rewritten(small, tmp_path / "x.mcap", facts={"robots": names})
    for use in (read_log, read_series):
        assert re.search(NAMES[names], error_line(use, path))
    assert "robots = " in error_line(again, path)


CONFIGURATIONS = {
    "deep": b"[" * 100_000,
    "deep keys": b'{"a":' * 50_000,
    "no object": b"[]",
    "a huge whole number": b'{"seed": ' + b"9" * 5000 + b"}",
    "a negative seed": b'{"seed": -1}',
    "a text for a number": b'{"seed": "x"}',
    "a number for a choice": b'{"noise": 3}',
    "a number for faults": b'{"faults": 7}',
    "numbers for faults": b'{"faults": [7]}',
    "an unknown fault": b'{"faults": ["explode"]}',
    "a robot that there is not": b'{"robot": 1000000}',
    "an unknown key": b'{"sneed": 1}',
    "an unknown mode": b'{"mode": 99}',
    "cells that last for ever": b'{"battery_used_min": Infinity}',
    "no cells": b'{"battery_used_min": NaN}',
    "used for years": b'{"battery_used_min": 1e300}',
    "an unknown model": b'{"model": "khepera9"}',
    "no JSON": b"seed = 1",
    "an escape": b'{"\\u001b[2J": 1}',
    "half a character": b'{"rom": "\\ud800"}',
}


@pytest.mark.parametrize("name", CONFIGURATIONS)
def test_configurations_that_cannot_be_are_one_line(small: Path, tmp_path: Path, name: str) -> None:
    change = attached("configuration.json", CONFIGURATIONS[name])
    error_line(again, rewritten(small, tmp_path / "x.mcap", attachment=change))


@pytest.mark.parametrize(
    "content", [b"", b"\xff", b"a = [" * 5000, b"x = 1\ny = 2\n", b"name = 3" + b" " * 2**20]
)
@pytest.mark.parametrize("name", ["playpen.toml", "calibration/khepera0.toml"])
def test_attached_files_that_cannot_be_are_one_line(
    small: Path, tmp_path: Path, name: str, content: bytes
) -> None:
    path = rewritten(small, tmp_path / "x.mcap", attachment=attached(name, content))
    assert name in error_line(lambda path: make_report(read_series(path), str(path)), path)
    error_line(again, path)


LAMPS = [
    *(b"", b"[", b"[]", b"{}", b"[" * 50_000),
    b'{"lamp": 3, "lighting": {}}',
    b'{"lamp": [{"x_mm": 1e999}], "lighting": {"mode": 3}}',
    b'{"lamp": [], "lighting": {"mode": "all"}, "x": ' + b"9" * 5000 + b"}",
]
POSES = [(float("nan"), 1, 1), (1e308, 1e308, 0), (-5, 3, 0), (100, 100, float("inf"))]


@pytest.mark.parametrize(
    ("kind", "data"),
    [
        *((HostEventKind.SET_LAMPS, data) for data in LAMPS),
        *((HostEventKind.MOVE_ROBOT, struct.pack("<3d", *pose)) for pose in POSES),
        (HostEventKind.SWITCH_LAMP, struct.pack("<i?", -7, True)),
    ],
    ids=lambda parameter: parameter.name if isinstance(parameter, HostEventKind) else "",
)
def test_lamps_and_positions_that_cannot_be_are_one_line(
    small: Path, tmp_path: Path, kind: HostEventKind, data: bytes
) -> None:
    message = events_message([(0, HostEvent(kind, 0, None, data))])
    error_line(again, rewritten(small, tmp_path / "x.mcap", instead("/khepera0/host_events", message)))


def test_a_robot_s_speed_that_is_no_number_is_one_line(small: Path, tmp_path: Path) -> None:
    message = events_message([(0, HostEvent(HostEventKind.SEND, 0, None, b"B\n"))])
    facts = {"baud": "9" * 5000}
    path = rewritten(small, tmp_path / "x.mcap", instead("/khepera0/host_events", message), facts=facts)
    line = error_line(lambda path: replay_to_port(read_recorded_run(path), "khep://obstacles"), path)
    assert "baud = 9999" in line


def test_a_host_that_set_its_line_is_still_believed(small: Path, tmp_path: Path) -> None:
    events = [
        (0, HostEvent(HostEventKind.LINE_SETTINGS, 0, LineSettings(3_000_000, 2))),
        (5, HostEvent(HostEventKind.LINE_SETTINGS, 0, LineSettings(0, 1))),
        (5, HostEvent(HostEventKind.DISCONNECT, 0)),
    ]
    path = rewritten(small, tmp_path / "x.mcap", instead("/khepera0/host_events", events_message(events)))
    assert [(time_ns, event) for time_ns, _, event in read_recorded_run(path).events] == events


def test_times_beyond_all_bounds_are_one_line(small: Path, tmp_path: Path) -> None:
    late = rewritten(small, tmp_path / "late.mcap", time=lambda topic, time_ns: 2**64 - 1)
    for use in (read_log, read_series, read_recorded_run, read_arrays, read_end_ns):
        assert "expected at most" in error_line(use, late)
    line = line_message(TextLine(2**31 * SECOND - SECOND, Level.INFO, "host", "N"))
    path = rewritten(small, tmp_path / "line.mcap", instead("/khepera0/serial", line))
    assert "expected at most 10.20 s" in error_line(again, path)


SCENES = {
    "many of one": "<mujoco><worldbody><replicate count='1000'/></worldbody></mujoco>",
    "another file": "<mujoco><worldbody><include file='/etc/passwd'/></worldbody></mujoco>",
    "deep": f"<mujoco><worldbody>{'<body>' * 5000}{'</body>' * 5000}</worldbody></mujoco>",
    "no XML": "scene",
    "nothing": "",
    "another document": "<svg/>",
    "no robot": "<mujoco><worldbody/></mujoco>",
    "no size": "<mujoco><worldbody><geom size='nan'/></worldbody></mujoco>",
    "laughs": "<!DOCTYPE x [<!ENTITY a 'ha'><!ENTITY b '&a;&a;'>]><mujoco>&b;&c;</mujoco>",
}


@pytest.mark.parametrize("name", SCENES)
def test_scenes_that_cannot_be_are_one_line(small: Path, tmp_path: Path, name: str) -> None:
    path = rewritten(small, tmp_path / "x.mcap", attachment=attached("scene.xml", SCENES[name].encode()))
    assert "scene.xml: " in error_line(lambda path: view([path], tmp_path / "x.rrd"), path)


def test_a_scene_of_a_run_has_all_its_shapes(small: Path) -> None:
    label = read_label(small)
    model = compile_shapes(label.attachments, label.robots, small)
    with open_twin("obstacles", TwinOptions(seed=3)) as twin:
        original_model = twin.world.model
    for name in ("nbody", "ngeom", "ncam", "nq"):
        assert getattr(model, name) == getattr(original_model, name), name
    assert np.allclose(model.geom_pos, original_model.geom_pos, atol=1e-6)


@pytest.mark.parametrize("topic", ["/tf", "/khepera0/proximity", "/events"])
def test_a_view_of_a_foreign_message_is_one_line(small: Path, tmp_path: Path, topic: str) -> None:
    path = rewritten(small, tmp_path / "x.mcap", instead(topic, CDR_HEADER + bytes(5)))
    if topic != "/events":  # there is none
        error_line(lambda path: view([path], tmp_path / "x.rrd"), path)


def with_schemas(small: Path, path: Path, old: bytes, new: bytes) -> Path:
    """A log whose schemas have other bytes, as many."""

    def changed(record: Record) -> Record:
        inner = tuple(changed(part) for part in record.inner)
        is_schema = record.opcode == Opcode.SCHEMA
        return replace(
            record, inner=inner, content=record.content.replace(old, new) if is_schema else record.content
        )

    path.write_bytes(assemble_log([changed(record) for record in parse_records(small.read_bytes())]))
    return path


def test_a_view_of_types_that_no_viewer_can_read_is_one_line(small: Path, tmp_path: Path) -> None:
    path = with_schemas(small, tmp_path / "x.mcap", b"uint32 size", b"uint32= size"[:11])
    line = error_line(lambda path: view([path], tmp_path / "x.rrd"), path)
    assert "rerun cannot show it: " in line
    assert not (tmp_path / "x.rrd").exists()


def test_types_with_names_of_zero_bytes_are_refused(small: Path, tmp_path: Path) -> None:
    path = with_schemas(small, tmp_path / "x.mcap", b"rcl_interfaces", b"\0cl_interfaces")
    assert "printable names" in error_line(lambda path: view([path], tmp_path / "x.rrd"), path)
    assert read_log(rescue(path).path).robots


def test_what_is_not_attached_is_one_line_or_not_needed(small: Path, tmp_path: Path) -> None:
    for missing in ("playpen.toml", "scene.xml", "configuration.json", "calibration/khepera0.toml"):
        path = rewritten(small, tmp_path / "x.mcap", attachment=attached(missing, None))
        recording: Recording = read_series(path)
        make_report(recording, str(path))
        if missing != "scene.xml":
            assert missing in error_line(again, path)


def test_an_answer_is_shown_without_what_a_terminal_would_obey(small: Path, tmp_path: Path) -> None:
    line = line_message(TextLine(0, Level.INFO, "robot", "\x1b[2J\nx" + "y" * 500))
    path = rewritten(small, tmp_path / "x.mcap", instead("/khepera0/serial", line))
    difference = repeat(read_recorded_run(path))
    assert difference is not None
    assert difference.recorded.isprintable()
    assert len(difference.recorded) < 200


def test_the_configuration_of_a_run_is_still_read(small: Path) -> None:
    label = read_label(small)
    assert json.loads(label.attachments["configuration.json"])["seed"] == 3
    assert repeat(read_recorded_run(small)) is None


LINES = {
    "no text at all": b"",
    "what a terminal would obey": b"\x1b]0;owned\x07\x9b2J",
    "no UTF-8": b"\xff\xfe\x80",
    "numbers beyond all bounds": b"e,99999999999999999999999999,-99999999999999999999999999",
    "too few numbers": b"h,1",
    "no number": b"n,nan,inf,1e999,,,x,0x10",
    "a line without end": b"n" + b",1023" * 20_000,
    "a command of nobody": b"%,%,%,\0,\0",
}


@pytest.mark.share(2)
@pytest.mark.parametrize("name", LINES)
def test_a_line_of_anything_is_a_result_or_one_line_for_shadow_and_conform(
    driven: Path, tmp_path: Path, name: str
) -> None:
    def anything(topic: str, time_ns: int, before: bytes) -> bytes:
        if not topic.endswith("/serial"):
            return before
        line = read_line(before)
        return LineFrame(line.name, line.level).message(line.time_ns, LINES[name])

    log = rewritten(driven, tmp_path / "x.mcap", anything)
    for words in (["conform", log], ["shadow", "obstacles", log, "-o", tmp_path / "shadow.mcap"]):
        ended = khep_twin(*words)
        errors = ended.stderr.splitlines()
        assert ended.returncode in (0, 1, 2, 4), ended
        assert all(line.isprintable() for line in [*ended.stdout.splitlines(), *errors]), ended
        if ended.returncode == 2:
            assert str(log) in errors[-1]
        (tmp_path / "shadow.mcap").unlink(missing_ok=True)


@pytest.mark.parametrize("data", [b"", CDR_HEADER, b"\xff" * 40, MESSAGES["/khepera0/serial"]])
def test_messages_of_a_line_that_cannot_be_are_one_line_for_shadow_and_conform(
    driven: Path, tmp_path: Path, data: bytes
) -> None:
    log = rewritten(driven, tmp_path / "x.mcap", instead("/khepera0/serial", data))
    for use in (conform_recording, read_recording):
        assert "; expected " in error_line(use, log)


@pytest.mark.parametrize("topic", ["tf", "x", "", "/", "//tf", "proximity", "a/b/c/registers"])
def test_topics_of_any_form_are_read_over(small: Path, tmp_path: Path, topic: str) -> None:
    path = rewritten(
        small,
        tmp_path / "x.mcap",
        rename=lambda old_topic: topic if old_topic == "/khepera0/leds" else old_topic,
    )
    for use in (read_log, read_series, read_recorded_run, read_arrays):
        use(path)
