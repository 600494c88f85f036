"""A robot's line from a log: its exchanges, each beside what the board's own code makes of it.

The log is a twin's, or a relay's at a real robot; of either only the line and its times are used, and what
the label says of the robot. `board_model` has the board's own code.
"""

import re
from collections import defaultdict, deque
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from khep_twin.board.protocol import LINE_END
from khep_twin.board.rom import ROMS
from khep_twin.board.turrets import find
from khep_twin.board.uart import HostEvent, HostEventKind, SerialLine
from khep_twin.clock import NS_PER_S
from khep_twin.errors import LogError
from khep_twin.lab.conformance.recording.board_model import (
    BoardModel,
    KnownRobot,
    RecordedStep,
    TimedExchange,
    versions,
    wrong_modes,
)
from khep_twin.log.channels import TextLine
from khep_twin.log.decoding import DecodeError, decoded, read_line
from khep_twin.log.entries import Label
from khep_twin.log.exchanges import BANNER, Dialogue, Exchange
from khep_twin.log.host_events import read_events
from khep_twin.log.reader import read_raw, require_kheperas_in
from khep_twin.log.transcript import bytes_of
from khep_twin.units import BITS_PER_BYTE

_SET_SPEED = re.compile(r"the line is at ([1-9][0-9]{2,6}) baud")
"""Event of a relay whose host has set another speed (`khep_twin.ports.relay`)."""


@dataclass(slots=True)
class RecordedLine:
    """The line of one robot of a log.

    Attributes:
        name: Name of the robot in the log.
        simulated: True for a twin, whose times are exact.
        noisy: True unless the log says that its sensors had no noise.
        rom: Name of the ROM: that of the twin, or the one that fits the replies best.
        mode: Running mode; None if unknown.
        turrets: Numbers of the turrets; None if unknown.
        changes_ns: Times at which the user moved a robot, a lamp or a sensor's conversion [ns].
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
        """One line that says what was checked."""
        what = f"a twin in mode {self.mode:X}" if self.mode is not None else "a robot"
        asked = sum(bool(step.exchange.command) for step in self.steps)
        return f"{self.name}: {what}, compared with ROM {self.rom}: {asked} commands"


def recorded_lines(path: Path) -> list[RecordedLine]:
    """Read the lines of all robots of a log that a host has talked to.

    Raises:
        LogError: There is no log, it is not whole, or nothing crossed a line in it.
    """
    channels = ("/host_events", "/serial", "/events")
    label, found, _ = read_raw(path, lambda topic: topic.endswith(channels))
    require_kheperas_in(label, path, "the checks of a recording")
    known = _robots_of(label, path)
    events: dict[str, list[HostEvent]] = {}
    for name in label.robots:
        topic = f"/{name}/host_events"
        pieces = decoded(path, topic, found, lambda data: [each for _, each in read_events(data)])
        events[name] = [event for _, piece in pieces for event in piece]
    changes_ns = sorted(
        event.at_ns for each in events.values() for event in each if event.kind > HostEventKind.SET
    )
    notes = [line for _, line in decoded(path, "/events", found, read_line)]
    lines: list[RecordedLine] = []
    for index, name in enumerate(label.robots):
        told = [line for _, line in decoded(path, f"/{name}/serial", found, read_line)]
        if not told:
            continue
        robot = known[index]
        if "seed" in label.metadata:
            timed = _of_a_twin(told, events[name])
        else:
            timed = _of_a_relay(told, events[name], _bauds(label, notes))
        resets_ns = [
            event.at_ns for event in events[name] if event.kind == HostEventKind.PUT and len(event.data) > 24
        ]
        lines.append(_line(name, label, robot, timed, changes_ns, resets_ns))
    if not lines:
        raise LogError(f"{path}: nothing crossed a line in it; expected a log of khep-twin run or serve")
    return lines


def _robots_of(label: Label, path: Path) -> list[KnownRobot]:
    if "playpen.toml" not in label.attachments:
        return [KnownRobot()] * len(label.robots)
    from khep_twin.log.attached import playpen_of

    entries = playpen_of(label.attachments, path).robots
    if len(entries) != len(label.robots):
        raise DecodeError(f"{len(label.robots)} robots", f"{len(entries)}, those of its playpen.toml").at(
            path, "metadata"
        )
    return [KnownRobot(entry.rom, entry.mode, tuple(find(entry.turrets))) for entry in entries]


def _of_a_twin(told: Sequence[TextLine], events: Sequence[HostEvent]) -> list[TimedExchange]:
    """Return the exchanges of a twin, whose transcript has each command where the robot took it.

    In the order of the file a command is followed by its replies, however many commands are waiting.
    """
    # A twin's replies have the time of their last byte, and a list of 2 kB takes its time.
    dialogue, found = Dialogue(give_up_ns=60 * NS_PER_S), list[Exchange]()
    leaving, begun = deque[tuple[int, bytes]](), b""
    for event in events:
        if event.kind == HostEventKind.SEND:
            begun = LINE_END.split(begun + event.data)[-1]
        elif event.kind == HostEventKind.DISCONNECT:
            leaving.append((event.at_ns, begun))
            begun = b""
    rest = b""
    for line in told:
        data, to_robot = bytes_of(line.text), line.name == "host"
        while to_robot and leaving and _is_later(line.time_ns, data, *leaving[0]):
            # The robot forgets an unfinished line, the transcript has it before the next one.
            rest = leaving.popleft()[1] or rest
            found += dialogue.close()
        if to_robot and rest:
            data, rest = data.removeprefix(rest), b""
        found += dialogue.feed(line.time_ns, to_robot, data + b"\n")
    found += dialogue.close()
    return [TimedExchange(each, each.sent_ns, 0) for each in found]


def _is_later(time_ns: int, line: bytes, left_ns: int, begun: bytes) -> bool:
    """Return whether a line is of another host than the one that left with an unfinished line."""
    return left_ns < time_ns or (left_ns == time_ns and begun != b"" and line.startswith(begun))


def _bauds(label: Label, notes: Sequence[TextLine]) -> list[tuple[int, int]]:
    """Return the speeds of a relay's line [baud] from their times [ns] on; none if they are not known."""
    text = label.metadata.get("baud", "")
    if not re.fullmatch("[1-9][0-9]{2,6}", text) or "://" in label.metadata.get("relay", "://"):
        return []
    changes = [
        (note.time_ns, int(match[1])) for note in notes if (match := _SET_SPEED.search(note.text)) is not None
    ]
    return [(0, int(text)), *changes]


def _of_a_relay(
    told: Sequence[TextLine], events: Sequence[HostEvent], bauds: Sequence[tuple[int, int]]
) -> list[TimedExchange]:
    """Return the exchanges of a real robot, from the host's bytes and the transcript's replies."""
    pieces = [
        (event.at_ns, True, piece)
        for event in events
        if event.kind == HostEventKind.SEND
        for piece in re.findall(rb"[^\r\n]*[\r\n]|[^\r\n]+", event.data)
    ]
    pieces += [(line.time_ns, False, bytes_of(line.text) + b"\n") for line in told if line.name == "robot"]
    speeds, line = deque(bauds), SerialLine(0)
    dialogue, found = Dialogue(), list[tuple[Exchange, int]]()
    arrivals: dict[int, list[int]] = defaultdict(list)
    for time_ns, to_robot, data in sorted(pieces, key=lambda piece: piece[0]):
        while speeds and speeds[0][0] <= time_ns:
            line.baud = speeds.popleft()[1]
        dialogue.byte_ns = line.byte_ns
        if to_robot:
            arrived_ns = line.put(data, time_ns)
            line.read(time_ns)
            if data[-1:] in b"\r\n" and data.strip(b"\r\n"):
                arrivals[time_ns].append(arrived_ns)
        found += ((each, line.baud) for each in dialogue.feed(time_ns, to_robot, data))
    found += ((each, line.baud) for each in dialogue.close())
    timed: list[TimedExchange] = []
    for each, baud in sorted(found, key=lambda pair: pair[0].sent_ns):
        waiting = arrivals[each.sent_ns] if each.command else []
        timed.append(TimedExchange(each, waiting.pop(0) if waiting else each.sent_ns, baud))
    return timed


def _line(
    name: str,
    label: Label,
    known: KnownRobot,
    timed: Sequence[TimedExchange],
    changes_ns: Sequence[int],
    resets_ns: Sequence[int],
) -> RecordedLine:
    """Return the line with the replies of the board's own code, of the ROM that fits best."""
    simulated = "seed" in label.metadata
    unpaced = label.metadata.get("unpaced") == "True"
    baud = 0 if known.mode is None or unpaced else ROMS[known.rom].modes[known.mode].baud
    ordered = sorted(timed, key=lambda each: _begun_ns(each, timed, baud or each.baud))
    numbers = None if known.turrets is None else tuple(kind.number for kind in known.turrets)

    def steps(rom: str) -> list[RecordedStep]:
        board = BoardModel(ROMS[rom], known, ordered)
        return list(board.steps(ordered, resets_ns, simulated, unpaced))

    told = {each.exchange.reply for each in timed if each.exchange.letter == "B"}
    names = (
        [known.rom] if known.rom else [key for key, rom in ROMS.items() if versions(rom) in told] or [*ROMS]
    )
    tried = [(key, steps(key)) for key in names]
    rom, found = min(tried, key=lambda pair: wrong_modes(pair[1], ROMS[pair[0]]))
    noisy = label.metadata.get("noise") != "False"
    return RecordedLine(name, simulated, noisy, rom, known.mode, numbers, changes_ns, found)


def _begun_ns(each: TimedExchange, timed: Sequence[TimedExchange], baud: int) -> int:
    """Return when a command was sent, or when a robot that restarts by itself began with its banner [ns]."""
    exchange = each.exchange
    if exchange.command or BANNER not in (exchange.reply or b"") or not baud:
        return exchange.sent_ns
    # A twin's lines have the time of the last one.
    lines = [
        other.exchange.reply or b""
        for other in timed
        if other.exchange.heard_ns == exchange.heard_ns and not other.exchange.command
    ]
    length = sum(len(line) + 2 for line in lines)
    return exchange.heard_ns - length * BITS_PER_BYTE * NS_PER_S // baud
