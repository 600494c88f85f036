"""Several hosts on one world in lock-step: each a blocking script in a thread of its own, one at a time.

    from khep_twin.lab.experiment.multi_robot import run_together

    def follow(robot): ...
    def flee(robot): ...

    run_together("two-robots.toml", [follow, flee], TwinOptions(seed=1))

A script runs until it waits for simulated time; then the one that waits for the earliest time goes on, of two
for the same time that of the robot with the lower number. So the order never depends on the machine, and the
same scripts and seed give the same run, bit for bit.
"""

import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from khep_twin.errors import PortError
from khep_twin.host import Khepera
from khep_twin.playpen import Playpen
from khep_twin.ports.protocol_khep import Serial
from khep_twin.ports.twin import Twin, TwinOptions, open_twin

TIMEOUT = 1.0
"""Longest wait of each script for a reply [s of simulated time]."""


def run_together(
    playpen: str | Path | Playpen, scripts: Sequence[Callable[[Khepera], Any]], options: TwinOptions
) -> list[Any]:
    """Runs a script for each robot of a playpen, all on one world; returns what they return.

    Args:
        playpen: with as many robots as there are scripts.
        scripts: in the order of the robots; each is given its robot and blocks as it likes.
        options: of the twin.

    Raises:
        PortError: there are more or fewer scripts than robots.
        Exception: what the first script that failed has raised, once all have ended.
    """
    with open_twin(playpen, replace(options, robot=None)) as twin:
        if len(scripts) != len(twin.robots):
            raise PortError(f"{len(scripts)} scripts for {len(twin.robots)} robots; right is one for each")
        seats = [_Seat(twin, index, script) for index, script in enumerate(scripts)]
        for seat in seats:
            seat.start()
        while waiting := [seat for seat in seats if not seat.done]:
            seat = min(waiting, key=lambda seat: (seat.goal_ns, seat.index))
            twin.advance_to(seat.goal_ns)
            seat.go_on()
    for seat in seats:
        if seat.error is not None:
            raise seat.error
    return [seat.result for seat in seats]


class _Seat:
    """One script, its thread, and the time that it waits for.

    Attributes:
        index: of its robot.
        goal_ns: until when it waits [ns].
        done: whether it has ended.
        result: what it has returned.
        error: what it has raised.
    """

    def __init__(self, twin: Twin, index: int, script: Callable[[Khepera], Any]) -> None:
        self.index = index
        self.goal_ns = 0
        self.done = False
        self.result: Any = None
        self.error: BaseException | None = None
        self._script = script
        self._robot = Khepera(Serial.of(_View(twin, index, self), timeout=TIMEOUT))
        self._turn, self._pause = threading.Semaphore(0), threading.Semaphore(0)
        self._thread = threading.Thread(target=self._run, name=f"khepera{index}", daemon=True)

    def start(self) -> None:
        """Makes the thread, which waits for its turn."""
        self._thread.start()

    def go_on(self) -> None:
        """Lets the script run until it waits again or ends."""
        self._turn.release()
        self._pause.acquire()

    def wait_until(self, time_ns: int) -> None:
        """Called by the script's thread: gives the turn away until it is that time."""
        self.goal_ns = time_ns
        self._pause.release()
        self._turn.acquire()

    def _run(self) -> None:
        self._turn.acquire()
        try:
            with self._robot:
                self.result = self._script(self._robot)
        except BaseException as error:  # told by run_together, to whoever called it
            self.error = error
        finally:
            self.done = True
            self._pause.release()


class _View(Twin):
    """A shared twin as one of its scripts sees it: to let time pass is to wait for one's turn."""

    def __init__(self, twin: Twin, index: int, seat: _Seat) -> None:
        super().__init__(twin.world, (twin.robots[index],), twin.options)
        self._seat = seat

    def advance_to(self, time_ns: int) -> None:
        """Waits until the world has come to this time."""
        if time_ns > self.world.time_ns:
            self._seat.wait_until(time_ns)

    def close(self) -> None:
        """The world goes on for the others."""
