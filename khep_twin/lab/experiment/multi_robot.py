"""Several hosts on one world in lockstep: each a blocking script in its own thread, one at a time.

    from khep_twin.lab.experiment.multi_robot import run_together

    def follow(robot): ...
    def flee(robot): ...

    run_together("two-robots.toml", [follow, flee], TwinOptions(seed=1))

A script runs until it waits for simulated time; then the script with the earliest time resumes, of equal ones
that with the lower robot number. The order does not depend on the machine, and the same scripts and seed give
the same run, bit for bit.
"""

import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Generic, TypeVar

from khep_twin.errors import PortError
from khep_twin.host import Khepera
from khep_twin.playpen import Playpen
from khep_twin.ports.protocol_khep import Serial
from khep_twin.ports.twin import Twin, TwinOptions, open_twin

Result = TypeVar("Result")

TIMEOUT = 1.0
"""Longest wait of each script for a reply [s of simulated time]."""


def run_together(
    playpen: str | Path | Playpen, scripts: Sequence[Callable[[Khepera], Result]], options: TwinOptions
) -> list[Result]:
    """Run a script for each robot of a playpen, all on one world; return their results.

    Args:
        playpen: Playpen with as many robots as there are scripts.
        scripts: Scripts in the order of the robots; each is called with its robot and may block.
        options: Options of the twin.

    Raises:
        PortError: There are more or fewer scripts than robots.
        Exception: Exception of the first script that failed, once all have ended.
    """
    with open_twin(playpen, replace(options, robot=None)) as twin:
        if len(scripts) != len(twin.robots):
            raise PortError(f"{len(scripts)} scripts for {len(twin.robots)} robots; expected one for each")
        seats = [_Seat(twin, index, script) for index, script in enumerate(scripts)]
        while waiting := [seat for seat in seats if not seat.done]:
            seat = min(waiting, key=lambda seat: (seat.goal_ns, seat.index))
            twin.advance_to(seat.goal_ns)
            seat.resume()
    for seat in seats:
        if seat.error is not None:
            raise seat.error
    return [seat.result for seat in seats]


class _Seat(Generic[Result]):
    """A script, its thread, and the time that it waits for: the `TimeSource` of its robot's port."""

    def __init__(self, twin: Twin, index: int, script: Callable[[Khepera], Result]) -> None:
        self.index = index
        self.goal_ns = 0
        self.done = False
        self.result: Result
        self.error: BaseException | None = None
        self._world, self._script = twin.world, script
        # Its port closes this view; the world goes on for the other scripts.
        view = Twin(twin.world, (twin.robots[index],), twin.options, self)
        self._robot = Khepera(Serial.of(view, timeout=TIMEOUT))
        self._turn, self._pause = threading.Semaphore(0), threading.Semaphore(0)
        # The thread waits for its turn.
        threading.Thread(target=self._run, name=f"khepera{index}", daemon=True).start()

    def resume(self) -> None:
        """Run the script until it waits again or ends."""
        self._turn.release()
        self._pause.acquire()

    def advance_to(self, time_ns: int) -> None:
        """Block the script's thread until the world has reached this time [ns]."""
        if time_ns > self._world.time_ns:
            self.goal_ns = time_ns
            self._pause.release()
            self._turn.acquire()

    def attend(self) -> None:
        """Do nothing: the other scripts take their turns while this one waits."""

    def _run(self) -> None:
        self._turn.acquire()
        try:
            with self._robot:
                self.result = self._script(self._robot)
        except BaseException as error:  # raised again by run_together
            self.error = error
        finally:
            self.done = True
            self._pause.release()
