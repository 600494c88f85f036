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
from collections.abc import Callable, Mapping, Sequence
from contextvars import copy_context
from dataclasses import replace
from functools import partial
from typing import Generic, TypeVar

from khep_twin.clock import TimeSource
from khep_twin.errors import KhepTwinError, PortError
from khep_twin.host import Khepera
from khep_twin.playpen import PlaypenLike
from khep_twin.ports.protocol_khep import Serial
from khep_twin.ports.twin import Twin, TwinOptions, open_twin

Result = TypeVar("Result")

TIMEOUT = 1.0
"""Longest wait of each script for a reply [s of simulated time]."""


def run_together(
    playpen: PlaypenLike, scripts: Sequence[Callable[[Khepera], Result]], options: TwinOptions
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
        return drive_together(twin, dict(enumerate(scripts)))


def drive_together(twin: Twin, scripts: Mapping[int, Callable[[Khepera], Result]]) -> list[Result]:
    """Run scripts for some robots of a twin, by their numbers, until all have ended; return their results.

    A single one runs in the caller's thread. An error of the twin, such as its end, breaks off all of them.

    Raises:
        Exception: Exception of the first script that failed, once all have ended.
    """
    if len(scripts) == 1:
        [(index, script)] = scripts.items()
        with _robot_of(twin, index, twin.time_source) as robot:
            return [script(robot)]
    seats = [_Seat(twin, index, script) for index, script in scripts.items()]
    while waiting := [seat for seat in seats if not seat.done]:
        seat = min(waiting, key=lambda seat: (seat.goal_ns, seat.index))
        try:
            twin.advance_to(seat.goal_ns)
        except KhepTwinError as error:
            if any(each.broken_off for each in waiting):
                raise
            for each in waiting:
                each.broken_off = error
        seat.resume()
    for seat in seats:
        if seat.error is not None:
            raise seat.error
    return [seat.result for seat in seats]


def _robot_of(twin: Twin, index: int, time_source: TimeSource) -> Khepera:
    """Return a robot of a twin on a port of its own; closing it keeps the world for the others."""
    view = Twin(twin.world, (twin.robots[index],), twin.options, time_source)
    return Khepera(Serial.of(view, timeout=TIMEOUT))


class _Seat(Generic[Result]):
    """A script, its thread, and the time that it waits for: the `TimeSource` of its robot's port."""

    def __init__(self, twin: Twin, index: int, script: Callable[[Khepera], Result]) -> None:
        self.index = index
        self.goal_ns = 0
        self.done = False
        self.result: Result
        self.error: BaseException | None = None
        self.broken_off: KhepTwinError | None = None
        self._told = False
        self._world, self._script = twin.world, script
        self._robot = _robot_of(twin, index, self)
        self._turn, self._pause = threading.Semaphore(0), threading.Semaphore(0)
        # The thread waits for its turn; what it prints goes where the caller's goes.
        run = partial(copy_context().run, self._run)
        threading.Thread(target=run, name=f"khepera{index}", daemon=True).start()

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
            if self.broken_off is not None and not self._told:
                self._told = True  # only once: the commands that stop the motors must still pass
                raise self.broken_off

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
