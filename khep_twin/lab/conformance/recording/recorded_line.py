"""Serial line of a robot in a log: its exchanges, each with the expected reply of the firmware.

The log is of a twin, or of a relay, a program that passes and logs the bytes between a host and a real robot.
Only the serial data with its times, and the description of the robot in the log's label, are used.
`board_model` runs the firmware.
"""

import re
from collections import defaultdict, deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from khep_twin.board.protocol import LINE_END
from khep_twin.board.rom import ROMS
from khep_twin.board.turrets import find_turrets
from khep_twin.board.uart import HostEvent, HostEventKind, SerialLine
from khep_twin.clock import NS_PER_S
from khep_twin.errors import LogError
from khep_twin.lab.conformance.recording.board_model import (
    BoardModel,
    KnownRobot,
    RecordedStep,
    TimedExchange,
    count_wrong_modes,
    version_reply,
)
from khep_twin.log.channels import TextLine
from khep_twin.log.decoding import DecodeError, decode_messages, read_line
from khep_twin.log.entries import Label
from khep_twin.log.exchanges import BANNER, Dialogue, Exchange
from khep_twin.log.host_events import read_events
from khep_twin.log.reader import read_raw, require_feature_in
from khep_twin.log.transcript import unescape
from khep_twin.robots.model import Feature
from khep_twin.units import BITS_PER_BYTE

_SET_SPEED = re.compile(r"the line is at ([1-9][0-9]{2,6}) baud")
"""Event of a relay when its host sets another baud rate (`khep_twin.ports.relay`)."""


@dataclass(slots=True)
class RecordedLine:
    """The line of one robot of a log.

    Attributes:
        name: Name of the robot in the log.
        simulated: True for a twin, whose times are exact.
        noisy: True unless the sensors had no noise by the log's metadata.
        rom: Name of the ROM: that of the twin, or the best match of the replies.
        mode: Running mode; None if unknown.
        turrets: Numbers of the turrets; None if unknown.
        changes_ns: Times of a user's changes: robots moved, lamps set, conversions replaced, or notes [ns].
        steps: Exchanges in order of their commands.
    """

    name: str
    simulated: bool
    noisy: bool
    rom: str
    mode: int | None
    turrets: tuple[int, ...] | None
    changes_ns: Sequence[int]
    steps: Sequence[RecordedStep] = field(repr=False)

    @property
    def text(self) -> str:
        """One line that describes the checked robot."""
        subject = f"a twin in mode {self.mode:X}" if self.mode is not None else "a robot"
        n_commands = sum(bool(step.exchange.command) for step in self.steps)
        return f"{self.name}: {subject}, compared with ROM {self.rom}: {n_commands} commands"


def recorded_lines(path: Path) -> list[RecordedLine]:
    """Read the lines of all robots of a log that have received or sent serial data.

    Raises:
        LogError: The log is missing or incomplete, or has no serial data.
    """
    channels = ("/host_events", "/serial", "/events")
    label, messages, _ = read_raw(path, lambda topic: topic.endswith(channels))
    require_feature_in(label, path, Feature.RECORDING_CHECKS)
    robots = _known_robots(label, path)
    events: dict[str, list[HostEvent]] = {}
    for name in label.robots:
        topic = f"/{name}/host_events"
        pieces = decode_messages(path, topic, messages, lambda data: list(read_events(data)))
        events[name] = [event for _, piece in pieces for _, event in piece]
    all_events = [event for robot_events in events.values() for event in robot_events]
    changes_ns = sorted(event.at_ns for event in all_events if event.kind > HostEventKind.LINE_SETTINGS)
    event_lines = [line for _, line in decode_messages(path, "/events", messages, read_line)]
    lines: list[RecordedLine] = []
    for index, name in enumerate(label.robots):
        transcript = [line for _, line in decode_messages(path, f"/{name}/serial", messages, read_line)]
        if not transcript:
            continue
        robot = robots[index]
        if "seed" in label.metadata:  # a twin; a relay has no seed
            exchanges = _twin_exchanges(transcript, events[name])
        else:
            exchanges = _relay_exchanges(transcript, events[name], _bauds(label, event_lines))
        moves = (event for event in events[name] if event.kind == HostEventKind.MOVE_ROBOT)
        resets_ns = [event.at_ns for event in moves if len(event.data) > 24]
        lines.append(_make_line(name, label, robot, exchanges, changes_ns, resets_ns))
    if not lines:
        raise LogError(f"{path}: no serial data in it; expected a log of khep-twin run or serve")
    return lines


def _known_robots(label: Label, path: Path) -> list[KnownRobot]:
    """Return each robot by the log's playpen: ROM, running mode and turrets."""
    if "playpen.toml" not in label.attachments:
        return [KnownRobot()] * len(label.robots)
    from khep_twin.log.attached import playpen_of

    entries = playpen_of(label.attachments, path).robots
    if len(entries) != len(label.robots):
        raise DecodeError(
            f"{len(label.robots)} robots", f"{len(entries)}, those of its playpen.toml"
        ).to_log_error(path, "metadata")
    return [KnownRobot(entry.rom, entry.mode, tuple(find_turrets(entry.turrets))) for entry in entries]


def _twin_exchanges(transcript: Sequence[TextLine], events: Sequence[HostEvent]) -> list[TimedExchange]:
    """Return the exchanges of a twin, whose transcript has each command at the time of its processing.

    In the order of the file a command is followed by its replies, even if further commands are pending.
    """
    # A twin's replies have the time of their last byte, and the transmission of a list of 2 kB takes 2 s.
    dialogue, exchanges = Dialogue(timeout_ns=60 * NS_PER_S), list[Exchange]()
    departures, unfinished = deque[tuple[int, bytes]](), b""
    for event in events:
        if event.kind == HostEventKind.SEND:
            unfinished = LINE_END.split(unfinished + event.data)[-1]
        elif event.kind == HostEventKind.DISCONNECT:
            departures.append((event.at_ns, unfinished))
            unfinished = b""
    rest = b""
    for line in transcript:
        data, to_robot = unescape(line.text), line.name == "host"
        while to_robot and departures and _is_next_host(line.time_ns, data, *departures[0]):
            # The robot drops an unfinished line; the transcript has it before the next line.
            rest = departures.popleft()[1] or rest
            exchanges += dialogue.close()
        if to_robot and rest:
            data, rest = data.removeprefix(rest), b""
        exchanges += dialogue.feed(line.time_ns, to_robot, data + b"\n")
    exchanges += dialogue.close()
    return [TimedExchange(exchange, exchange.sent_ns, 0) for exchange in exchanges]


def _is_next_host(time_ns: int, line: bytes, left_ns: int, unfinished: bytes) -> bool:
    """Return whether a line is from a later host than the one that left with an unfinished line."""
    return left_ns < time_ns or (left_ns == time_ns and unfinished != b"" and line.startswith(unfinished))


def _bauds(label: Label, event_lines: Sequence[TextLine]) -> list[tuple[int, int]]:
    """Return the baud rates of a relay's line with their start times [ns]; none if they are not known."""
    text = label.metadata.get("baud", "")
    if not re.fullmatch("[1-9][0-9]{2,6}", text) or "://" in label.metadata.get("relay", "://"):
        return []
    changes = [
        (line.time_ns, int(match[1])) for line in event_lines if (match := _SET_SPEED.search(line.text))
    ]
    return [(0, int(text)), *changes]


def _relay_exchanges(
    transcript: Sequence[TextLine], events: Sequence[HostEvent], bauds: Sequence[tuple[int, int]]
) -> list[TimedExchange]:
    """Return the exchanges of a real robot, from the host's bytes and the transcript's replies."""
    pieces = [
        (event.at_ns, True, piece)
        for event in events
        if event.kind == HostEventKind.SEND
        for piece in re.findall(rb"[^\r\n]*[\r\n]|[^\r\n]+", event.data)
    ]
    pieces += [
        (line.time_ns, False, unescape(line.text) + b"\n") for line in transcript if line.name == "robot"
    ]
    pending_bauds, line = deque(bauds), SerialLine(0)
    dialogue, exchanges = Dialogue(), list[tuple[Exchange, int]]()
    arrivals: dict[int, list[int]] = defaultdict(list)
    for time_ns, to_robot, data in sorted(pieces, key=lambda piece: piece[0]):
        while pending_bauds and pending_bauds[0][0] <= time_ns:
            line.baud = pending_bauds.popleft()[1]
        dialogue.byte_ns = line.byte_ns
        if to_robot:
            arrived_ns = line.send(data, time_ns)
            line.read(time_ns)
            if data[-1:] in b"\r\n" and data.strip(b"\r\n"):
                arrivals[time_ns].append(arrived_ns)
        exchanges += ((exchange, line.baud) for exchange in dialogue.feed(time_ns, to_robot, data))
    exchanges += ((exchange, line.baud) for exchange in dialogue.close())
    timed: list[TimedExchange] = []
    for exchange, baud in sorted(exchanges, key=lambda pair: pair[0].sent_ns):
        pending = arrivals[exchange.sent_ns] if exchange.command else []
        timed.append(TimedExchange(exchange, pending.pop(0) if pending else exchange.sent_ns, baud))
    return timed


def _make_line(
    name: str,
    label: Label,
    robot: KnownRobot,
    exchanges: Sequence[TimedExchange],
    changes_ns: Sequence[int],
    resets_ns: Sequence[int],
) -> RecordedLine:
    """Return the line with the expected replies of the ROM that matches best."""
    simulated = "seed" in label.metadata
    unpaced = label.metadata.get("unpaced") == "True"
    baud = 0 if robot.mode is None or unpaced else ROMS[robot.rom].modes[robot.mode].baud
    ordered = sorted(exchanges, key=lambda timed: _start_ns(timed, exchanges, baud or timed.baud))
    numbers = None if robot.turrets is None else tuple(kind.number for kind in robot.turrets)

    def steps(rom: str) -> list[RecordedStep]:
        board = BoardModel(ROMS[rom], robot, ordered)
        return list(board.steps(ordered, resets_ns, simulated, unpaced))

    replies = {timed.exchange.reply for timed in exchanges if timed.exchange.letter == "B"}
    matches = [key for key, rom in ROMS.items() if version_reply(rom) in replies]
    candidates = [(key, steps(key)) for key in ([robot.rom] if robot.rom else matches or [*ROMS])]
    rom, best_steps = min(candidates, key=lambda pair: count_wrong_modes(pair[1], ROMS[pair[0]]))
    noisy = label.metadata.get("noise") != "False"
    return RecordedLine(name, simulated, noisy, rom, robot.mode, numbers, changes_ns, best_steps)


def _start_ns(timed: TimedExchange, exchanges: Sequence[TimedExchange], baud: int) -> int:
    """Return when a command was sent, or when a robot that restarts unasked started its banner [ns]."""
    exchange = timed.exchange
    if exchange.command or BANNER not in (exchange.reply or b"") or not baud:
        return exchange.sent_ns
    # All lines of a twin's banner have the time of the last one.
    lines = [
        other.exchange.reply or b""
        for other in exchanges
        if other.exchange.reply_ns == exchange.reply_ns and not other.exchange.command
    ]
    length = sum(len(line) + 2 for line in lines)
    return exchange.reply_ns - length * BITS_PER_BYTE * NS_PER_S // baud
