"""Recordings of sound robots have no findings; each wrong robot is caught by the right statement."""

import itertools
import json
import re
from collections.abc import Callable
from pathlib import Path

import pytest
from command_line import khep_twin
from mcap.reader import make_reader
from mcap.writer import Writer

from checks.recordings import Relay, findings, tour
from khep_twin.interventions.move_robot import place_robot
from khep_twin.lab.conformance.recording.conform import CheckedRobot, conform_recording
from khep_twin.lab.conformance.recording.recorded_line import recorded_lines
from khep_twin.lab.experiment.controllers import BUILT_IN
from khep_twin.log.channels import Level, LineFrame, TextLine
from khep_twin.log.decoding import read_line
from khep_twin.playpen import Playpen
from khep_twin.ports.twin import TwinOptions, open_twin

Change = Callable[[list[TextLine]], list[TextLine]]
"""From the transcript of a sound robot to that of a wrong one."""

MS = 1_000_000
LONG = pytest.mark.long

SCAN = "readings within one scan are equal, except of sensors converted in between"


def recorded(path: Path, playpen: str = "obstacles", **chosen: object) -> Path:
    """Log of a twin that has received all commands."""
    options = {"seed": 4, "mode": 3, "log": str(path), **chosen}
    with open_twin(playpen, TwinOptions(**options)) as twin:  # type: ignore[arg-type]
        tour(twin)
    return path


@pytest.fixture(scope="session")
def sound(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return recorded(tmp_path_factory.mktemp("sound") / "run.mcap")


def changed(path: Path, target: Path, change: Change) -> Path:
    """A copy of a log with another transcript."""
    topic = "/khepera0/serial"
    with path.open("rb") as file, target.open("wb") as copy:
        reader, writer = make_reader(file), Writer(copy)
        writer.start()
        for attachment in reader.iter_attachments():
            writer.add_attachment(0, 0, attachment.name, attachment.media_type, attachment.data)
        for record in reader.iter_metadata():
            writer.add_metadata(record.name, record.metadata)
        channels: dict[str, int] = {}
        transcript: list[TextLine] = []
        topics = [topic, "/khepera0/host_events"]
        for schema, channel, entry in reader.iter_messages(topics, log_time_order=False):
            assert schema is not None
            if channel.topic not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.topic] = writer.register_channel(channel.topic, "cdr", number)
            if channel.topic == topic:
                transcript.append(read_line(entry.data))
            else:
                writer.add_message(channels[channel.topic], entry.log_time, entry.data, entry.log_time)
        for line in change(transcript):
            message = LineFrame(line.name, Level.INFO).message(line.time_ns, line.text.encode())
            writer.add_message(channels[topic], line.time_ns, message, line.time_ns)
        writer.finish()
    return target


def checked(path: Path) -> CheckedRobot:
    (robot,) = conform_recording(path).robots
    return robot


def failed(robot: CheckedRobot) -> list[str]:
    return [statement.name for statement in robot.statements if statement.findings]


# Wrong robots --------------------------------------------------------------------------------------------


def replies(pattern: str, replacement: str | Callable[[re.Match[str]], str]) -> Change:
    """Every reply that matches is changed."""
    return each_reply(lambda command, reply: re.sub(pattern, replacement, reply))


def to(command: str, replacement: str) -> Change:
    """Replies to a command are changed."""
    return each_reply(lambda request, reply: replacement if re.fullmatch(command, request) else reply)


def each_reply(answer: Callable[[str, str], str]) -> Change:
    """Replies are changed depending on the request; "" is silence."""

    def change(lines: list[TextLine]) -> list[TextLine]:
        request, answers = "", list[TextLine]()
        for line in lines:
            if line.name == "host":
                request = line.text
                answers.append(line)
            elif text := answer(request, line.text):
                answers.append(TextLine(line.time_ns, line.level, line.name, text))
        return answers

    return change


def shifted(pattern: str, by_ms: float) -> Change:
    """Replies that match come earlier or later."""
    return lambda lines: [
        TextLine(line.time_ns + round(by_ms * MS), line.level, line.name, line.text)
        if line.name == "robot" and re.match(pattern, line.text)
        else line
        for line in lines
    ]


def echo(lines: list[TextLine]) -> list[TextLine]:
    return [
        answer
        for line in lines
        for answer in (
            [line, TextLine(line.time_ns, line.level, "robot", line.text)] if line.name == "host" else [line]
        )
    ]


def every(count: int, answer: Callable[[str], str]) -> Change:
    """Every n-th reply is changed."""
    numbers = itertools.count(1)
    return each_reply(lambda command, reply: reply if next(numbers) % count else answer(reply))


def each_of(letter: str, change: Change) -> Change:
    """Only replies of a letter are changed."""

    def change_selected(lines: list[TextLine]) -> list[TextLine]:
        selected = [line.name == "robot" and line.text.startswith(letter) for line in lines]
        answers = iter(
            change([line for line, is_selected in zip(lines, selected, strict=True) if is_selected])
        )
        return [
            next(answers) if is_selected else line for line, is_selected in zip(lines, selected, strict=True)
        ]

    return change_selected


def at_the_end(change: Change) -> Change:
    """Replies after the last restart are changed."""
    return lambda lines: lines[:-10] + change(lines[-10:])


def exchanged(status: re.Match[str]) -> str:
    """A reply to K with the codes of speed and position mode exchanged."""
    fields = status[0].split(",")
    fields[2], fields[5] = ("102"[int(fields[index])] for index in (2, 5))
    return ",".join(fields)


def negated(field: int) -> Callable[[re.Match[str]], str]:
    def negate(match: re.Match[str]) -> str:
        fields = match[0].split(",")
        fields[field] = str(-int(fields[field]))
        return ",".join(fields)

    return negate


WRONG: dict[str, tuple[Change, str]] = {
    "E answers with h": (replies("^e,", "h,"), "a reply starts with its command's letter"),
    "upper-case replies": (replies("^e,", "E,"), "a reply starts with its command's letter"),
    "seven sensors": (replies("^(n(,\\d+){7}),\\d+$", r"\1"), "a reply has as many plain integers"),
    "nine sensors": (replies("^n(.*)$", r"n\1,0"), "a reply has as many plain integers"),
    "leading zeros": (replies(r"^(h),(\d)", r"\1,0\2"), "a reply has as many plain integers"),
    "decimals": (replies(r"^e,(-?\d+),(-?\d+)", r"e,\1.0,\2.0"), "a reply has as many plain integers"),
    "a value behind an order": (to("D,5,5", "d,5,5"), "a reply has as many plain integers"),
    "eleven bits": (replies(r"^n,\d+", "n,1024"), "values are in the range"),
    "negative light": (replies(r"^o,\d+", "o,-5"), "values are in the range"),
    "speeds without end": (replies(r"^e,1\d,", "e,400,"), "values are in the range"),
    "H of 33 bits": (to("H", "h,2147483648,0"), "values are in the range"),
    "refuses channel 0": (to("I,0", "z,Protocol error"), "a valid command is not refused"),
    "takes any parameters": (to("D,1,2,3", "d"), "missing, surplus or wrong parameters"),
    "errors with a dot": (replies("^z,P.*", "z,Protocol error."), "missing, surplus or wrong"),
    "unknown words with z": (replies("^Command", "z,Command"), "an unknown word"),
    "Q is a command": (to("Q", "q"), "an unknown word"),
    "LED 5": (to("L,5,0", "l"), "an LED, channel or address"),
    "turret without number": (to("T,1,B", "t,b,1,2"), "a turret answers under its number"),
    "no help": (to("help", "Command not found"), "a tool is answered"),
    "another version at the end": (at_the_end(replies("^b,5.02", "b,5.03")), "B reads the versions"),
    "no banner": (to("restart", "ok"), "a restart shows the banner"),
    "the banner of another": (replies("Rev. 5.01", "Rev. 4.06"), "a restart shows the banner"),
    "silent at times": (every(50, lambda reply: ""), "every command is answered"),
    "silent at E": (to("E", ""), "every command is answered"),
    "echo": (echo, "the robot sends nothing unsolicited"),
    "an unasked line": (every(50, lambda reply: f"{reply}\nready"), "the robot sends nothing unsolicited"),
    "answers at once": (shifted("n,", -3), "no reply ends before"),
    "thinks for 40 ms": (shifted("h,", 40), "replies start within 10 ms"),
    "counts backwards": (replies("^h,.*", negated(1)), "counters agree with the speeds that E"),
    "E with the wrong sign": (replies("^e,.*", negated(2)), "E reads the speeds that D sets"),
    "E is always 0": (replies("^e,.*", "e,0,0"), "E reads the speeds that D sets"),
    "counters stand still": (replies("^h,.*", "h,0,0"), "counters agree with the speeds that D"),
    "counters leap": (every(71, lambda reply: re.sub("^h,", "h,1", reply)), "counters change no faster"),
    "G is not obeyed": (replies(r"^h,70\d*,-\d*", "h,0,0"), "G sets the counters"),
    "counters of 16 bits": (replies(r"^h,70\d*,-\d*", "h,4464,-4464"), "G sets the counters"),
    "counters outlive a restart": (at_the_end(replies("^h,.*", "h,69000,-69000")), "a restart sets the"),
    "modes of ROM 4.06": (replies(r"^k,.*", exchanged), "K has the mode"),
    "on target at rest": (replies(r"^k,\d,0,", "k,1,0,"), "K's target flag"),
    "an error in PWM mode": (replies(r"^k,0,2,0", "k,0,2,7"), "K's error"),
    "an error on the target": (replies(r"^k,1,1,-?\d+", "k,1,1,40"), "K's error"),
    "on target at once": (replies(r"^k,0,1,-?\d+", "k,1,1,0"), "a wheel that is on its target by K"),
    "never there": (replies(r"^k,1,1,", "k,0,1,"), "K reports a wheel on its target"),
    "a stuck sensor": (replies(r"^(n(,\d+){3}),\d+", r"\1,77"), "no sensor repeats its reading"),
    "a table of readings": (replies(r"^n.*", "n,9,8,7,6,500,400,3,200"), "readings change while"),
}  # fmt: skip


FIRST = {statement: name for name, (_, statement) in reversed(WRONG.items())}
"""First wrong robot of each statement, for the suite."""


@pytest.mark.share(3)
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name in FIRST.values() else LONG) for name in WRONG]
)
def test_a_wrong_robot_is_caught_and_what_is_wrong_is_named(name: str, sound: Path, tmp_path: Path) -> None:
    change, statement = WRONG[name]
    names = failed(checked(changed(sound, tmp_path / "wrong.mcap", change)))
    assert any(failure.startswith(statement) for failure in names), names


def test_a_copy_that_changes_nothing_has_no_finding(sound: Path, tmp_path: Path) -> None:
    assert failed(checked(changed(sound, tmp_path / "copy.mcap", lambda lines: lines))) == []


@pytest.mark.share(6)
@pytest.mark.parametrize(
    ("fault", "statement"),
    [
        ("stuck:2@1", "no sensor repeats its reading"),
        ("dead:left@2", "counters agree with the speeds that D"),
        ("late:0.1:60", "replies start within 10 ms"),
        ("drop:0.01", "a reply has as many plain integers"),
        ("garble:0.01", "a reply has as many plain integers"),
    ],
)
def test_a_faulty_robot_is_caught(fault: str, statement: str, tmp_path: Path) -> None:
    names = failed(checked(recorded(tmp_path / "run.mcap", faults=(fault,))))
    assert any(failure.startswith(statement) for failure in names), names


def test_values_that_change_within_a_scan_are_caught(tmp_path: Path) -> None:
    log = recorded(tmp_path / "run.mcap", unpaced=True)
    robot = checked(log)
    assert robot.passed
    assert {statement.name: statement.seen for statement in robot.statements}[SCAN] > 100
    new = every(2, lambda reply: re.sub(r"(?<=,)\d+", lambda value: str(int(value[0]) ^ 1), reply))
    assert failed(checked(changed(log, tmp_path / "wrong.mcap", each_of("n", new)))) == [SCAN]


# Sound robots --------------------------------------------------------------------------------------------


def test_everything_but_scans_is_seen_in_the_tour(sound: Path) -> None:
    robot = checked(sound)
    assert robot.passed, conform_recording(sound).text()
    assert [statement.name for statement in robot.statements if not statement.seen] == [SCAN]


@pytest.mark.share(3)
@pytest.mark.parametrize("seed", range(3))
def test_no_host_makes_a_sound_robot_wrong(seed: int, tmp_path: Path) -> None:
    assert findings(seed, tmp_path, seconds=8.0) == []


@pytest.mark.share(3)
@pytest.mark.parametrize("rom", ["4.06", "5.02", "khepera2"])
def test_a_relay_finds_the_rom_by_the_replies(rom: str, tmp_path: Path) -> None:
    path = tmp_path / "relay.mcap"
    with open_twin("obstacles", TwinOptions(seed=2, mode=2, rom=rom)) as twin:
        relay = Relay(twin)
        tour(twin)
    relay.write(path)
    robot = checked(path)
    assert robot.passed, conform_recording(path).text()
    assert f"a robot, compared with ROM {rom}" in robot.text


@pytest.mark.share(3)
@pytest.mark.parametrize("controller", BUILT_IN)
def test_built_in_controllers_meet_a_sound_robot(controller: str, tmp_path: Path) -> None:
    log = tmp_path / "run.mcap"
    khep_twin("run", controller, "--playpen", "obstacles", "--seconds", "5", "--log", str(log))
    assert checked(log).passed


def test_a_brown_out_is_told_and_what_follows_is_as_at_power_up(tmp_path: Path) -> None:
    robot = checked(recorded(tmp_path / "run.mcap", faults=("brown-out@3",)))
    assert robot.passed
    (banner,) = [statement for statement in robot.statements if statement.name.startswith("a restart shows")]
    assert banner.seen == 2
    assert banner.note.startswith("unsolicited at 3.0")


def test_each_robot_of_a_log_is_checked(field: Playpen, tmp_path: Path) -> None:
    log, (robot,) = tmp_path / "run.mcap", field.robots
    robots = (robot, robot.model_copy(update={"x_mm": 3000, "rom": "4.06"}))
    with open_twin(
        field.model_copy(update={"robots": robots}), TwinOptions(robot=None, log=str(log))
    ) as twin:
        twin.robots[0].send(b"D,5,5\nK\n")
        twin.robots[1].send(b"D,5,5\nK\nB\n")
        twin.advance_to(200 * MS)
    report = conform_recording(log)
    assert report.passed
    assert [robot.text for robot in report.robots] == [
        "khepera0: a twin in mode 1, compared with ROM 5.02: 2 commands",
        "khepera1: a twin in mode 1, compared with ROM 4.06: 3 commands",
    ]


# The command ---------------------------------------------------------------------------------------------


def test_the_command_reports_each_robot_of_a_log(sound: Path, tmp_path: Path) -> None:
    ended = khep_twin("conform", str(sound), "--report", str(tmp_path / "report.json"))
    assert ended.returncode == 0
    assert ended.stdout.endswith("khepera0: 28 passed, 0 failed, 1 not seen\n")
    assert json.loads((tmp_path / "report.json").read_text())["robots"][0]["passed"]


def test_a_finding_has_time_command_what_was_given_and_what_was_expected(sound: Path, tmp_path: Path) -> None:
    wrong = changed(sound, tmp_path / "wrong.mcap", replies("^i,.*", "i,1024"))
    ended = khep_twin("conform", str(wrong))
    assert ended.returncode == 1
    assert "s  I,0: 1024 in the reply i,1024; expected 0 to 1023\n" in ended.stdout


def test_options_of_a_port_and_logs_without_a_line_are_refused(sound: Path, tmp_path: Path) -> None:
    assert "--move is for a port, not for a log" in khep_twin("conform", str(sound), "--move").stderr
    log = tmp_path / "run.mcap"
    with open_twin("default", TwinOptions(log=str(log))) as twin:
        twin.advance_to(MS)
    assert "no serial data" in khep_twin("conform", str(log)).stderr


# A K213 --------------------------------------------------------------------------------------------------


def test_the_messages_of_a_k213_are_known_also_to_who_only_hears_them(tmp_path: Path) -> None:
    log, relay_log = tmp_path / "run.mcap", tmp_path / "relay.mcap"
    with open_twin("stripes", TwinOptions(seed=4, mode=3, log=str(log))) as twin:
        relay = Relay(twin)
        for message in ("B", "N", "M", "S", "T", "L", "O", "P", "Q,3", "R,4", "U,2", "Q,99", "X", "N"):
            twin.robot.send(f"T,2,{message}\n".encode())
            twin.advance_to(twin.world.time_ns + 300 * MS)
    relay.write(relay_log)
    for path in (log, relay_log):
        assert failed(checked(path)) == []
    worse = changed(log, tmp_path / "worse.mcap", replies(r"^t,2,q,\d+", "t,2,q"))
    assert failed(checked(worse)) == ["a turret answers under its number, an absent one is refused"]


def test_a_move_resets_the_modelled_board_only_if_it_reset_the_robot(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with open_twin("default", TwinOptions(log=str(path))) as twin:
        for command, reset in ((b"G,100,200\n", None), (b"H\n", False), (b"H\n", True), (b"H\n", None)):
            twin.robot.send(command)
            twin.advance_to(twin.world.time_ns + 100 * MS)
            if reset is not None:
                place_robot(twin.world, 0, 300, 300, 0, reset=reset)
    (line,) = recorded_lines(path)
    replies = [(step.exchange.reply, step.expected.strip()) for step in line.steps]
    assert replies == [(reply, reply) for reply in (b"g", b"h,100,200", b"h,100,200", b"h,0,0")]
