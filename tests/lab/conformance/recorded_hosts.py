"""Hosts of all sorts at random, for logs whose lines are checked."""

from collections.abc import Callable
from contextlib import suppress
from typing import Any

import numpy as np

from khep_twin.errors import PlaypenError
from khep_twin.interventions.move_robot import put, scan
from khep_twin.ports.twin import Twin
from khep_twin.units import STEP_NS

MS = 1_000_000

READS = [
    "E",
    "H",
    "N",
    "O",
    "K",
    "B",
    "I,0",
    "I,1",
    "I,2",
    "I,6",
    "R,5",
    "T,1,B",
    "T,1,H,1",
    "T,1,G",
    "T,2,B",
]
WRONG = [
    "D",
    "D,1",
    "D,1,2,3",
    "D,a,b",
    "C,1",
    "I",
    "I,9",
    "L,0",
    "L,5,0",
    "R",
    "R,99",
    "W,1",
    "N,1",
    "T",
    "T,1",
]
WORDS = ["hello", "d,5,5", " ", "?", "XY", "x" * 200, "D," + "1" * 200, "Q", "\x01\x02", "a\\b"]
TOOLS = [
    "help",
    "list",
    "net",
    "k-team",
    "memory",
    "process",
    "sfill",
    "help D",
    "run test",
    "restart",
    "restart",
]


class Host:
    """A host of a twin that does what comes by chance.

    Args:
        twin: Its twin.
        rng: Chance.
    """

    def __init__(self, twin: Twin, rng: np.random.Generator) -> None:
        self._twin, self._rng = twin, rng
        self._end = "\n"

    def live(self, seconds: float) -> None:
        """Do this and that for a time."""
        deeds: list[Callable[[], None]] = [
            self._ask, self._burst, self._poll, self._drive, self._drive, self._move, self._set, self._err,
            self._use, self._idle, self._vanish, self._lift,
        ]  # fmt: skip
        end_ns = self._twin.world.time_ns + round(seconds * 1e9)
        while self._twin.world.time_ns < end_ns:
            self._end = str(self._rng.choice(["\n", "\r", "\r\n"]))
            deeds[self._rng.integers(len(deeds))]()

    def say(self, *commands: str, wait_ms: float | None = None) -> None:
        """Send commands at once, and wait for their replies or a time."""
        robot, world = self._twin.robot, self._twin.world
        robot.send("".join(f"{command}{self._end}" for command in commands).encode("latin-1"))
        wait_ns = int(self._rng.exponential(10 * MS)) if wait_ms is None else round(wait_ms * MS)
        while wait_ms is None and (robot.uart.rx.next_ns is not None or robot.uart.tx.next_ns is not None):
            self._twin.advance_to(world.time_ns + STEP_NS)
            robot.uart.tx.read(world.time_ns)
        self._twin.advance_to(world.time_ns + max(wait_ns // STEP_NS, 1) * STEP_NS)
        robot.uart.tx.read(world.time_ns)

    def _some(self, *most: int) -> list[int]:
        return [int(self._rng.integers(-each, each + 1)) for each in most]

    def _ask(self) -> None:
        self.say(str(self._rng.choice(READS)))

    def _burst(self) -> None:
        self.say(*map(str, self._rng.choice(READS, 7)))

    def _poll(self) -> None:
        for _ in range(40):
            self.say("N")
            self.say("D,{},{}".format(*self._some(15, 15)))

    def _drive(self) -> None:
        speeds = self._some(127, 127) if self._rng.random() < 0.3 else self._some(20, 20)
        self.say("D,{},{}".format(*speeds))
        letters = ["EH", "HE", "H", "E", "EHK", "N", "NO", "NN", "HK"][self._rng.integers(9)]
        for _ in range(self._rng.integers(10, 80)):
            self.say(*letters)

    def _move(self) -> None:
        counts = self._some(2000, 2000) if self._rng.random() < 0.8 else self._some(2**24, 2**24)
        self.say("G,{},{}".format(*self._some(2**31 - 1, 1000)) if self._rng.random() < 0.3 else "G,0,0")
        self.say("C,{},{}".format(*counts))
        for _ in range(self._rng.integers(10, 80)):
            self.say("K", "H")

    def _set(self) -> None:
        v, a = int(self._rng.integers(1, 40)), int(self._rng.integers(8, 200))
        settings = ["A,3800,800,100", "F,3000,20,4000", f"J,{v},{a},{v},{a}", "J,20,64,20,64", "L,0,2", "L,1,1",
                    "W,7,3", "P,{},{}".format(*self._some(300, 300)), "G,{},{}".format(*self._some(2**31, 9)),
                    "A,7600,800,100", "C,{},{}".format(*self._some(500, 500)), "T,1,D,0", "T,1,E,200"]  # fmt: skip
        self.say(str(self._rng.choice(settings)))

    def _err(self) -> None:
        self.say(*map(str, self._rng.choice([*WRONG, *WORDS], self._rng.integers(1, 4))))

    def _use(self) -> None:
        self.say(str(self._rng.choice(TOOLS)))
        if self._rng.random() < 0.2:
            self.say("serial 19200")

    def _idle(self) -> None:
        self._twin.advance_to(self._twin.world.time_ns + int(self._rng.integers(400)) * STEP_NS)

    def _vanish(self) -> None:
        self.say(
            *map(str, self._rng.choice([*READS, "D,3,3", "C,9,9", "restart"], 5)),
            wait_ms=self._rng.integers(60),
        )
        self._twin.robot.send(b"D,5")
        self._twin.robot.disconnect()

    def _lift(self) -> None:
        world: Any = self._twin.world
        if self._rng.random() < 0.3:
            x, y, heading = (float(each) for each in world.robots[0].pose)
            with suppress(PlaypenError):
                put(world, 0, x * 1e3, y * 1e3, heading * 57 + 90, afresh=self._rng.random() < 0.5)
                scan(world)
