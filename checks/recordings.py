"""Logs of twins with hosts of all sorts, in which `khep-twin conform` must find nothing.

Each log is of another playpen, ROM, mode and host, and is checked twice: as the twin's, and as a relay would
have recorded it. `conform` does not check logs of a Khepera IV: they must repeat without a difference.

    python -m checks recordings 300 --first 0
"""

import tempfile
from collections.abc import Callable
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from khep_twin.board.uart import HostEvent, HostEventKind
from khep_twin.clock import NS_PER_S
from khep_twin.errors import PlaypenError
from khep_twin.files.toml_files import names
from khep_twin.interventions.move_robot import place_robot, scan
from khep_twin.lab.conformance.recording.conform import conform_recording
from khep_twin.lab.experiment.repeat import repeat
from khep_twin.log.line_recorder import LineRecorder
from khep_twin.log.recorded import read_recorded_run
from khep_twin.observers import Observer
from khep_twin.playpen import Playpen
from khep_twin.ports.twin import Twin, TwinOptions, open_twin
from khep_twin.robots.model import Feature
from khep_twin.units import BITS_PER_BYTE, STEP_NS
from tools.command_table import command_line

MS = 1_000_000

READS = "E;H;N;O;K;B;I,0;I,1;I,2;I,6;R,5;T,1,B;T,1,H,1;T,1,G;T,2,B;T,2,N;T,2,L;T,2,Q,20;T,2,O;T,2,U,1".split(
    ";"
)
WRONG = "D;D,1;D,1,2,3;D,a,b;C,1;I;I,9;L,0;L,5,0;R;R,99;W,1;N,1;T;T,1".split(";")
WORDS = ["hello", "d,5,5", " ", "?", "XY", "x" * 200, "D," + "1" * 200, "Q", "\x01\x02", "a\\b"]
WORDS4 = "D,90,40;D,-300,200;N;O;E;R;G;S;T;V,0;V,9;K,9,0,0,0,9,0,0,0,9;F,900,500;L,9,0;U,5;X;A,0;Z;hi;K,1;D"
"""Commands of a Khepera IV, some of them wrong."""

TOOLS = "help;list;net;k-team;memory;process;sfill;help D;run test;restart;restart".split(";")


class Host:
    """Host of a twin that acts at random.

    Args:
        twin: Twin.
        rng: Random generator.

    Attributes:
        left: True if the host has left meanwhile, the robot was lifted or its line has another speed.
    """

    def __init__(self, twin: Twin, rng: np.random.Generator) -> None:
        self._twin, self._rng = twin, rng
        self._end = "\n"
        self.left = False

    def live(self, seconds: float) -> None:
        """Do this and that for a time."""
        deeds: list[Callable[[], None]] = [
            self._ask, self._burst, self._poll, self._drive, self._drive, self._move, self._set, self._err,
            self._use, self._idle,
        ]  # fmt: skip
        if self._rng.random() < 0.5:
            deeds += [self._vanish, self._lift]
        end_ns = self._twin.world.time_ns + round(seconds * 1e9)
        while self._twin.world.time_ns < end_ns:
            self._end = str(self._rng.choice(["\n", "\r", "\r\n"]))
            deeds[self._rng.integers(len(deeds))]()

    def say(self, *commands: str, pause_ms: float | None = None, replies: bool = True) -> None:
        """Send commands together, wait for their replies, and pause; the default pause is random."""
        robot, world = self._twin.robot, self._twin.world
        robot.send("".join(f"{command}{self._end}" for command in commands).encode("latin-1"))
        while replies and (robot.uart.rx.next_ns is not None or robot.uart.tx.next_ns is not None):
            self._twin.advance_to(world.time_ns + STEP_NS)
            robot.uart.tx.read(world.time_ns)
        pause_ns = self._rng.exponential(10 * MS) if pause_ms is None else pause_ms * MS
        self._twin.advance_to(world.time_ns + max(int(pause_ns) // STEP_NS, 1) * STEP_NS)
        robot.uart.tx.read(world.time_ns)

    def _random_integers(self, *limits: int) -> list[int]:
        return [int(self._rng.integers(-limit, limit + 1)) for limit in limits]

    def _ask(self) -> None:
        self.say(str(self._rng.choice(READS)))

    def _burst(self) -> None:
        self.say(*map(str, self._rng.choice(READS, 7)))

    def _poll(self) -> None:
        for _ in range(40):
            self.say("N")
            self.say("D,{},{}".format(*self._random_integers(15, 15)))

    def _drive(self) -> None:
        speeds = (
            self._random_integers(127, 127) if self._rng.random() < 0.3 else self._random_integers(20, 20)
        )
        self.say("D,{},{}".format(*speeds))
        letters = ["EH", "HE", "H", "E", "EHK", "N", "NO", "NN", "HK"][self._rng.integers(9)]
        for _ in range(self._rng.integers(10, 80)):
            self.say(*letters)

    def _move(self) -> None:
        counts = (
            self._random_integers(2000, 2000)
            if self._rng.random() < 0.8
            else self._random_integers(2**24, 2**24)
        )
        self.say(
            "G,{},{}".format(*self._random_integers(2**31 - 1, 1000)) if self._rng.random() < 0.3 else "G,0,0"
        )
        self.say("C,{},{}".format(*counts))
        for _ in range(self._rng.integers(10, 80)):
            self.say("K", "H")

    def _set(self) -> None:
        v, a = int(self._rng.integers(1, 40)), int(self._rng.integers(8, 200))
        settings = [
            *("A,3800,800,100", "A,7600,800,100", "F,3000,20,4000", f"J,{v},{a},{v},{a}", "J,20,64,20,64"),
            *(
                "L,0,2",
                "L,1,1",
                "W,7,3",
                "T,1,D,0",
                "T,1,E,200",
                "P,{},{}".format(*self._random_integers(300, 300)),
            ),
            *(
                "G,{},{}".format(*self._random_integers(2**31, 9)),
                "C,{},{}".format(*self._random_integers(500, 500)),
            ),
        ]
        self.say(str(self._rng.choice(settings)))

    def _err(self) -> None:
        self.say(*map(str, self._rng.choice([*WRONG, *WORDS], self._rng.integers(1, 4))))

    def _use(self) -> None:
        self.say(str(self._rng.choice(TOOLS)))
        if self._rng.random() < 0.2:
            self.left = True
            self.say("serial 19200")

    def _idle(self) -> None:
        self._twin.advance_to(self._twin.world.time_ns + int(self._rng.integers(400)) * STEP_NS)

    def _vanish(self) -> None:
        self.left = True
        commands = self._rng.choice([*READS, "D,3,3", "C,9,9", "restart"], 5)
        self.say(*map(str, commands), pause_ms=int(self._rng.integers(60)), replies=False)
        self._twin.robot.send(b"D,5")
        self._twin.robot.disconnect()

    def _lift(self) -> None:
        world: Any = self._twin.world
        if self._rng.random() < 0.3:
            x, y, heading = (float(value) for value in world.robots[0].pose)
            self.left = True
            with suppress(PlaypenError):
                place_robot(world, 0, x * 1e3, y * 1e3, heading * 57 + 90, reset=self._rng.random() < 0.5)
                scan(world)


def tour(twin: Twin) -> None:
    """Ask for everything once and for much often, as a host that tries a robot would; 25 s."""
    host = Host(twin, np.random.default_rng(1))
    for command in ("B", "K", "help", "list", "hello", "Q", "D", "D,1,2,3", "L,5,0", "L,0,1", "T,1,B", "R,5",
                    "I,0", "J,20,64,20,64", "A,3800,800,100", "F,3000,20,4000", "W,7,3", "B"):  # fmt: skip
        host.say(command)
    for speed, cycles in ((12, 220), (-12, 60)):
        host.say(f"D,{speed},{speed}")
        for _ in range(cycles):
            host.say("E", "H", "N", pause_ms=2)
    host.say("E\nH\nN\nO\nK\nB\nE")
    host.say("D,0,0", pause_ms=300)
    host.say("G,100,-50", pause_ms=10)
    for target in (400, 0):
        host.say(f"C,{target},{target}")
        for _ in range(25):
            host.say("K", "H", pause_ms=80)
    for command in ("P,20,20", "K", "D,5,5", "K", "D,0,0", "K", "O", "G,70000,-70000", "H"):
        host.say(command, pause_ms=40)
    for command in ("restart", "K", "H", "E", "B", "N"):
        host.say(command, pause_ms=200)


class Relay(Observer):
    """Record of a twin's line as by a relay at the robot.

    Args:
        twin: Twin, recorded from its start.
        robot: Number of the robot.
    """

    def __init__(self, twin: Twin, robot: int = 0) -> None:
        self._robot, self._baud = robot, twin.robots[robot].firmware.baud
        self._pieces: list[tuple[int, bool, bytes]] = []
        twin.world.add_observer(self)

    def on_bytes(self, time_ns: int, robot: int, to_robot: bool, data: bytes) -> None:
        """Hear the robot."""
        if not to_robot and robot == self._robot:
            rest = len(data)
            for line in data.splitlines(keepends=True):
                rest -= len(line)
                self._pieces.append((time_ns - rest * BITS_PER_BYTE * NS_PER_S // self._baud, False, line))

    def on_host_event(self, time_ns: int, robot: int, event: HostEvent) -> None:
        """Hear its host."""
        if event.kind == HostEventKind.SEND and robot == self._robot:
            self._pieces.append((event.at_ns, True, event.data))

    def write(self, path: Path) -> None:
        """Write the log."""
        now_ns = 0
        settings = {"relay": "/dev/ttyUSB0", "baud": self._baud}
        recorder = LineRecorder(path, settings, lambda: now_ns)
        for time_ns, to_robot, data in sorted(self._pieces, key=lambda piece: piece[0]):
            now_ns = time_ns
            recorder.on_bytes(to_robot, data)
        recorder.close()


def options(rng: np.random.Generator) -> TwinOptions:
    """Return a sound robot of any kind."""
    rom = (None, "5.02", "4.06", "khepera2")[rng.integers(4)]
    modes = [1, 2, 3, 0, 7, 8, 9, 8, 9] if rom == "khepera2" else [1, 2, 3, 0, 7]
    return TwinOptions(
        seed=int(rng.integers(2**31)),
        noise=bool(rng.random() < 0.8),
        vary=bool(rng.random() < 0.5),
        rom=rom,
        mode=int(rng.choice(modes)),
        model="khepera2" if rom == "khepera2" and rng.random() < 0.5 else None,
        unpaced=bool(rng.random() < 0.15),
        battery_used_min=float(rng.uniform(0, 30)) if rng.random() < 0.2 else None,
    )


def playpens_of(*, kheperas: bool) -> list[str]:
    """Return the shipped playpens with Kheperas, or those with a Khepera IV."""
    return [
        name
        for name in names("playpens")
        if all(Feature.LINE in robot.robot_model.features for robot in Playpen.load(name).robots) == kheperas
    ]


def repeat_findings(seed: int, rng: np.random.Generator, folder: Path, seconds: float) -> list[str]:
    """Return the finding in a random log of a Khepera IV, if its repetition differs."""
    log, playpens = folder / f"{seed}.mcap", playpens_of(kheperas=False)
    playpen = playpens[rng.integers(len(playpens))]
    chosen = TwinOptions(
        seed=int(rng.integers(2**31)),
        noise=bool(rng.random() < 0.8),
        vary=bool(rng.random() < 0.5),
        unpaced=bool(rng.random() < 0.15),
        log=str(log),
    )
    words = WORDS4.split(";")
    with open_twin(playpen, chosen) as twin:
        while twin.world.time_ns < seconds * NS_PER_S:
            twin.robot.send(f"{rng.choice(words)}\r\n".encode() * int(rng.integers(1, 3)))
            twin.advance_to(twin.world.time_ns + int(rng.integers(1, 200)) * STEP_NS)
            twin.robot.uart.tx.read(twin.world.time_ns)
    difference = repeat(read_recorded_run(log))
    log.unlink()
    return [] if difference is None else [f"{seed}: {playpen}, {chosen}\n{difference}"]


def findings(seed: int, folder: Path, seconds: float = 30.0) -> list[str]:
    """Return the findings in a random log, as a twin's and as a relay's."""
    rng = np.random.default_rng(seed)
    if seed % 5 == 4:
        return repeat_findings(seed, rng, folder, seconds)
    chosen, playpens = options(rng), playpens_of(kheperas=True)
    log, relayed = folder / f"{seed}.mcap", folder / f"{seed}_relay.mcap"
    with open_twin(playpens[rng.integers(len(playpens))], replace(chosen, log=str(log))) as twin:
        relay = Relay(twin)
        host = Host(twin, rng)
        host.live(seconds)
    relay.write(relayed)
    # A relay does not know of these, nor of the demonstration of mode 0.
    logs = [log] if chosen.unpaced or host.left or chosen.mode == 0 else [log, relayed]
    reports = [conform_recording(path) for path in logs]
    for path in (log, relayed):
        path.unlink()
    return [f"{seed}: {chosen}\n{report.text()}" for report in reports if not report.passed]


def main() -> int:
    """Check as many logs as wanted; return 1 if there is a finding."""
    parser = command_line(__doc__)
    parser.add_argument("count", type=int, nargs="?", default=300, help="number of logs")
    parser.add_argument("--first", type=int, default=0, help="number of the first one")
    wish, n_reports = parser.parse_args(), 0
    with tempfile.TemporaryDirectory() as folder:
        for seed in range(wish.first, wish.first + wish.count):
            for text in findings(seed, Path(folder)):
                n_reports += 1
                print(f"{text}\n", flush=True)
    print(f"{wish.count} logs, {n_reports} reports with findings")
    return min(n_reports, 1)
