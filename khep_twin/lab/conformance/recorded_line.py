"""A robot's line from a log: its exchanges, each beside what the board's own code makes of it.

The log is a twin's, or a relay's at a real robot; of either only the line and its times are used, and what
the label says of the robot. Commands that the robot has carried out are carried out by a `Firmware` of the
same ROM, too, which has no wheels and no sensors: it knows letters, errors, modes and settings.
"""

import re
from collections import defaultdict, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple, TypeVar

from khep_twin.board import kernel
from khep_twin.board.kernel import LEFT, RESET_VALUES, RIGHT, Board, Mode, Wheel
from khep_twin.board.protocol import COMMAND_NOT_FOUND, LINE_END, Request, Tool, parse
from khep_twin.board.rom import ROMS, Rom
from khep_twin.board.turrets import Turret, TurretKind, find
from khep_twin.board.uart import HostEvent, HostEventKind, SerialLine
from khep_twin.clock import NS_PER_S
from khep_twin.errors import LogError
from khep_twin.firmware import Firmware
from khep_twin.log.channels import TextLine
from khep_twin.log.decoding import Misfit, read_line
from khep_twin.log.exchanges import BANNER, Dialogue, Exchange
from khep_twin.log.host_events import read_events
from khep_twin.log.label import Label
from khep_twin.log.reader import read_raw
from khep_twin.units import BITS_PER_BYTE, GRIPPER_NUMBER

_GAINS = {register: value for register, value in RESET_VALUES if Board.SPEED_KP <= register <= Board.SPEED_KD}
_SET_SPEED = re.compile(r"the line is at ([1-9][0-9]{2,6}) baud")
"""Event of a relay whose host has set another speed (`khep_twin.ports.relay`)."""

_T = TypeVar("_T")


class Motion(NamedTuple):
    """Settings of the motors by the commands so far, left and right.

    Attributes:
        modes: Control modes.
        speeds: Speeds of D [pulses/10 ms].
        targets: Targets of C [pulses]; None where G has renumbered them since.
        on_target: Target flags as the last command has left them.
        profile: Lowest speed [pulses/10 ms] and acceleration [pulses/256 per (10 ms)^2] of J.
        usual_gains: True if the speed controllers have the gains of a reset.
    """

    modes: tuple[Mode, Mode]
    speeds: tuple[int, int]
    targets: tuple[int, int] | None
    on_target: tuple[int, int]
    profile: tuple[int, int]
    usual_gains: bool


@dataclass(frozen=True, slots=True)
class Step:
    """One exchange and the board's own.

    Attributes:
        exchange: Recorded exchange.
        arrived_ns: Earliest time at which the robot can have had the command [ns].
        byte_ns: Time of a byte of the reply on the line [ns]; 0 if it is unknown or none.
        request: Command as parsed; None for a line that came unasked.
        expected: Reply of the board's own code.
        motion: Settings of the motors after the command; None where they are unknown.
        exact: True if the robot had the command at its arrival, as a twin's transcript says.
    """

    exchange: Exchange
    arrived_ns: int
    byte_ns: int
    request: Request | None
    expected: bytes
    motion: Motion | None
    exact: bool

    @property
    def read_ns(self) -> int:
        """Latest time at which the values of the reply were read [ns]."""
        if self.exact:
            return self.arrived_ns
        length = len(self.exchange.reply or b"") + 2
        return max(self.exchange.heard_ns - length * self.byte_ns, self.arrived_ns)

    @property
    def restarts(self) -> bool:
        """True if the robot shows its banner, asked or not."""
        return BANNER in (self.exchange.reply or b"")


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
    steps: Sequence[Step] = field(repr=False)

    @property
    def text(self) -> str:
        """One line that says what was checked."""
        what = f"a twin in mode {self.mode:X}" if self.mode is not None else "a robot"
        asked = sum(bool(step.exchange.command) for step in self.steps)
        return f"{self.name}: {what}, held against ROM {self.rom}: {asked} commands"


def recorded_lines(path: Path) -> list[RecordedLine]:
    """Read the lines of all robots of a log that a host has talked to.

    Raises:
        LogError: There is no log, it is not whole, or nothing crossed a line in it.
    """
    channels = ("/host_events", "/serial", "/events")
    label, found, _ = read_raw(path, lambda topic: topic.endswith(channels))
    known = _robots_of(label, path)
    events: dict[str, list[HostEvent]] = {}
    for name in label.robots:
        topic = f"/{name}/host_events"
        pieces = _decoded(path, topic, found, lambda data: [each for _, each in read_events(data)])
        events[name] = [event for piece in pieces for event in piece]
    changes_ns = sorted(
        event.at_ns for each in events.values() for event in each if event.kind > HostEventKind.SET
    )
    notes = list(_decoded(path, "/events", found, read_line))
    lines: list[RecordedLine] = []
    for index, name in enumerate(label.robots):
        told = list(_decoded(path, f"/{name}/serial", found, read_line))
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


class _Known(NamedTuple):
    """What a log's label says of a robot.

    Attributes:
        rom: Name of its ROM; empty if unknown.
        mode: Running mode; None if unknown.
        turrets: Turrets; None if unknown.
    """

    rom: str = ""
    mode: int | None = None
    turrets: tuple[TurretKind, ...] | None = None


class _Timed(NamedTuple):
    """An exchange with the command's earliest arrival [ns] and the line's speed [baud], 0 if unknown."""

    exchange: Exchange
    arrived_ns: int
    baud: int


def _robots_of(label: Label, path: Path) -> list[_Known]:
    if "playpen.toml" not in label.attachments:
        return [_Known()] * len(label.robots)
    from khep_twin.log.attached import playpen_of

    entries = playpen_of(label.attachments, path).robots
    if len(entries) != len(label.robots):
        raise Misfit(f"{len(label.robots)} robots", f"{len(entries)}, those of its playpen.toml").at(
            path, "metadata"
        )
    return [_Known(entry.rom, entry.mode, tuple(find(entry.turrets))) for entry in entries]


def _decoded(
    path: Path, topic: str, found: Mapping[str, Sequence[tuple[int, bytes]]], decode: Callable[[bytes], _T]
) -> Iterator[_T]:
    for time_ns, data in found.get(topic, ()):
        try:
            yield decode(data)
        except Misfit as misfit:
            raise misfit.at(path, topic, time_ns) from None


def _bytes_of(line: TextLine) -> bytes:
    """Return a transcript's line as it was (`transcript.text_of`)."""
    try:
        return line.text.encode("ascii").decode("unicode_escape").encode("latin-1")
    except UnicodeError:
        return line.text.encode("utf-8")


def _of_a_twin(told: Sequence[TextLine], events: Sequence[HostEvent]) -> list[_Timed]:
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
        data, to_robot = _bytes_of(line), line.name == "host"
        while to_robot and leaving and _is_later(line.time_ns, data, *leaving[0]):
            # The robot forgets an unfinished line, the transcript has it before the next one.
            rest = leaving.popleft()[1] or rest
            found += dialogue.close()
        if to_robot and rest:
            data, rest = data.removeprefix(rest), b""
        found += dialogue.feed(line.time_ns, to_robot, data + b"\n")
    found += dialogue.close()
    return [_Timed(each, each.sent_ns, 0) for each in found]


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
) -> list[_Timed]:
    """Return the exchanges of a real robot, from the host's bytes and the transcript's replies."""
    pieces = [
        (event.at_ns, True, piece)
        for event in events
        if event.kind == HostEventKind.SEND
        for piece in re.findall(rb"[^\r\n]*[\r\n]|[^\r\n]+", event.data)
    ]
    pieces += [(line.time_ns, False, _bytes_of(line) + b"\n") for line in told if line.name == "robot"]
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
    timed: list[_Timed] = []
    for each, baud in sorted(found, key=lambda pair: pair[0].sent_ns):
        waiting = arrivals[each.sent_ns] if each.command else []
        timed.append(_Timed(each, waiting.pop(0) if waiting else each.sent_ns, baud))
    return timed


def _line(
    name: str,
    label: Label,
    known: _Known,
    timed: Sequence[_Timed],
    changes_ns: Sequence[int],
    resets_ns: Sequence[int],
) -> RecordedLine:
    """Return the line with the replies of the board's own code, of the ROM that fits best."""
    simulated = "seed" in label.metadata
    unpaced = label.metadata.get("unpaced") == "True"
    baud = 0 if known.mode is None or unpaced else ROMS[known.rom].modes[known.mode].baud
    ordered = sorted(timed, key=lambda each: _begun_ns(each, timed, baud or each.baud))
    numbers = None if known.turrets is None else tuple(kind.number for kind in known.turrets)

    def steps(rom: str) -> list[Step]:
        board = _Board(ROMS[rom], known, ordered)
        return list(board.steps(ordered, resets_ns, simulated, unpaced))

    told = {each.exchange.reply for each in timed if each.exchange.letter == "B"}
    names = (
        [known.rom] if known.rom else [key for key, rom in ROMS.items() if _versions(rom) in told] or [*ROMS]
    )
    tried = [(key, steps(key)) for key in names]
    rom, found = min(tried, key=lambda pair: wrong_modes(pair[1], ROMS[pair[0]]))
    noisy = label.metadata.get("noise") != "False"
    return RecordedLine(name, simulated, noisy, rom, known.mode, numbers, changes_ns, found)


def _begun_ns(each: _Timed, timed: Sequence[_Timed], baud: int) -> int:
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


def _versions(rom: Rom) -> bytes:
    return f"b,{rom.bios},{rom.protocol}".encode()


def wrong_modes(steps: Sequence[Step], rom: Rom) -> int:
    """Return the number of replies to K with other modes than those of a ROM."""
    wrong = 0
    for step in steps:
        if step.exchange.letter == "K" and step.motion is not None and len(step.exchange.values or ()) == 6:
            wrong += (step.exchange.values or ())[1::3] != tuple(
                rom.mode_codes[mode] for mode in step.motion.modes
            )
    return wrong


class _Board:
    """The board's own code, to which the recorded commands are told.

    Args:
        rom: Version of the firmware.
        known: What is known of the robot.
        timed: Exchanges, from which unknown turrets are guessed.
    """

    def __init__(self, rom: Rom, known: _Known, timed: Sequence[_Timed]) -> None:
        kinds = known.turrets
        if kinds is None:
            answered = any(
                (each.exchange.reply or b"").startswith(b"t,%d," % GRIPPER_NUMBER) for each in timed
            )
            kinds = tuple(find(["gripper"])) if answered else ()
        turrets: dict[TurretKind, Turret] = {kind: kind.make() for kind in kinds}
        self._firmware = Firmware(rom, 1 if known.mode is None else known.mode, turrets)
        # A robot that a relay finds has been on for long.
        self._sure = known.mode is not None
        self._gains_known = True
        self._targets: tuple[int, int] | None = None

    def steps(
        self, timed: Sequence[_Timed], resets_ns: Sequence[int], simulated: bool, unpaced: bool
    ) -> Iterator[Step]:
        """Yield the steps.

        Args:
            timed: Exchanges in order of their commands.
            resets_ns: Times at which a user reset the board [ns].
            simulated: True for a twin, whose line has the board's speed.
            unpaced: True for a line that takes no time.
        """
        resets = deque(resets_ns)
        for exchange, arrived_ns, line_baud in timed:
            while resets and resets[0] <= exchange.sent_ns:
                resets.popleft()
                kernel.reset(self._firmware.register_view)
                self._sure = self._gains_known = True
            expected = self._answer(exchange) if exchange.command else self._notice(exchange)
            speed = self._firmware.reply_baud if simulated and not unpaced else line_baud
            byte_ns = BITS_PER_BYTE * NS_PER_S // speed if speed else 0
            request = parse(exchange.command) if exchange.command else None
            yield Step(exchange, arrived_ns, byte_ns, request, expected, self._motion(), simulated)

    def _notice(self, unasked: Exchange) -> bytes:
        if BANNER in (unasked.reply or b""):
            self._firmware.reset()
            self._sure = self._gains_known = True
        return b""

    def _answer(self, exchange: Exchange) -> bytes:
        """Carry out a command as far as the robot has; return the board's own reply."""
        firmware, reply = self._firmware, exchange.reply
        before, settings = firmware.registers.copy(), (firmware.baud, firmware.running)
        expected = firmware.receive(exchange.command + b"\n")
        if expected.startswith((b"z,", COMMAND_NOT_FOUND)):
            return expected
        if reply is not None and is_error(reply):
            # The robot has not carried it out.
            firmware.registers[:] = before
            firmware.baud, firmware.running = settings
            return expected
        answered, restarted = reply is not None, BANNER in (reply or b"")
        if isinstance(parse(exchange.command), Tool):
            self._sure = restarted or (self._sure and answered)
            self._gains_known = restarted or self._gains_known
        elif exchange.letter == "A":
            self._gains_known = answered
        elif exchange.letter == "J":
            self._sure = self._sure and answered
        elif exchange.letter in ("C", "D", "P"):
            self._sure = answered
        if exchange.letter in ("C", "G"):
            targets = both(firmware.register_view, Wheel.TARGET)
            self._targets = targets if exchange.letter == "C" else None
        return expected

    def _motion(self) -> Motion | None:
        view = self._firmware.register_view
        if not self._sure or self._firmware.running:
            return None
        left, right = both(view, Wheel.MODE)
        return Motion(
            (Mode(left), Mode(right)),
            both(view, Wheel.SPEED_SETPOINT),
            self._targets,
            both(view, Wheel.ON_TARGET),
            (min(both(view, Wheel.MAX_SPEED)), min(both(view, Wheel.ACCELERATION))),
            self._gains_known and all(view[register] == value for register, value in _GAINS.items()),
        )


def both(registers: kernel.Registers, register: Wheel) -> tuple[int, int]:
    """Return a register of the left and of the right wheel."""
    return int(registers[LEFT + register]), int(registers[RIGHT + register])


def is_error(reply: bytes) -> bool:
    """Return whether a reply refuses a command."""
    return reply.startswith((b"z,", COMMAND_NOT_FOUND.strip()))
