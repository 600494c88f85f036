"""Several hosts on one world in lockstep: blocking scripts in separate threads, of which one runs at a time.

    from khep_twin.lab.experiment.multi_robot import run_together

    def follow(robot): ...
    def flee(robot): ...

    run_together("two-robots.toml", [follow, flee], TwinOptions(seed=1))

A script runs until it waits for simulated time. Then the script with the earliest wake-up time resumes; of
equal times, the one with the lower robot number. The order does not depend on the machine, and the same
scripts and seed yield the same run, bit for bit.
"""

import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future
from contextvars import copy_context
from dataclasses import replace
from functools import partial
from typing import Generic, TypeVar

from khep_twin.clock import TimeSource
from khep_twin.errors import KhepTwinError, PortError
from khep_twin.host.host_robot import HostRobot, open_robot
from khep_twin.lab.experiment.controllers import AnyRobot
from khep_twin.playpen import PlaypenLike
from khep_twin.ports.protocol_khep import Serial
from khep_twin.ports.twin import Twin, TwinOptions, open_twin
from khep_twin.robots.model import robot_name

ResultType = TypeVar("ResultType")

TIMEOUT = 1.0
"""Time-out of each script for a reply [s of simulated time]."""


def run_together(
    playpen: PlaypenLike, scripts: Sequence[Callable[[AnyRobot], ResultType]], options: TwinOptions
) -> list[ResultType]:
    """Run a script for each robot of a playpen, all on one world; return their results.

    Args:
        playpen: Playpen with as many robots as there are scripts.
        scripts: Scripts in the order of the robots; each is called with its robot and may block.
        options: Options of the twin.

    Raises:
        PortError: There are more or fewer scripts than robots.
        Exception: Exception of the first script that failed, after all have ended.
    """
    with open_twin(playpen, replace(options, robot=None)) as twin:
        if len(scripts) != len(twin.robots):
            raise PortError(f"{len(scripts)} scripts for {len(twin.robots)} robots; expected one for each")
        return drive_together(twin, dict(enumerate(scripts)))


def drive_together(twin: Twin, scripts: Mapping[int, Callable[[AnyRobot], ResultType]]) -> list[ResultType]:
    """Run scripts for some robots of a twin, by robot number, until all have ended; return their results.

    A single script runs in the caller's thread. An error of the twin, or its end, aborts all scripts.

    Raises:
        Exception: Exception of the first script that failed, after all have ended.
    """
    if len(scripts) == 1:
        [(index, script)] = scripts.items()
        with _open_robot(twin, index, twin.time_source) as robot:
            return [script(robot)]
    threads = [_ScriptThread(twin, index, script) for index, script in scripts.items()]
    while active := [thread for thread in threads if not thread.outcome.done()]:
        thread = min(active, key=lambda seat: (seat.wake_ns, seat.index))
        try:
            twin.advance_to(thread.wake_ns)
        except KhepTwinError as error:
            if any(thread.abort_error for thread in active):
                raise
            for thread in active:
                thread.abort_error = error
        thread.resume()
    return [thread.outcome.result() for thread in threads]


def _open_robot(twin: Twin, index: int, time_source: TimeSource) -> HostRobot:
    """Return a robot of a twin on a separate port; the world stays open when it is closed."""
    single_robot_twin = Twin(twin.world, (twin.robots[index],), twin.options, time_source)
    return open_robot(single_robot_twin.robot_model, Serial.of(single_robot_twin, timeout=TIMEOUT))


class _ScriptThread(Generic[ResultType]):
    """A script, its thread, and its wake-up time; the `TimeSource` of its robot's port."""

    def __init__(self, twin: Twin, index: int, script: Callable[[AnyRobot], ResultType]) -> None:
        self.index = index
        self.wake_ns = 0
        self.outcome = Future[ResultType]()
        self.abort_error: KhepTwinError | None = None
        self._is_abort_raised = False
        self._world = twin.world
        self._script = script
        self._robot = _open_robot(twin, index, self)
        self._turn = threading.Semaphore(0)
        self._paused = threading.Semaphore(0)
        # The thread waits for its turn; its output goes to the caller's output.
        run = partial(copy_context().run, self._run)
        threading.Thread(target=run, name=robot_name(index), daemon=True).start()

    def resume(self) -> None:
        """Run the script until it waits again or ends."""
        self._turn.release()
        self._paused.acquire()

    def advance_to(self, time_ns: int) -> None:
        """Block the script's thread until the world reaches this time [ns]."""
        if time_ns > self._world.time_ns:
            self.wake_ns = time_ns
            self._paused.release()
            self._turn.acquire()
            if self.abort_error is not None and not self._is_abort_raised:
                self._is_abort_raised = True  # once, as the commands that stop the motors must succeed
                raise self.abort_error

    def attend(self) -> None:
        """Do nothing: other scripts run while this one waits."""

    def _run(self) -> None:
        self._turn.acquire()
        try:
            with self._robot:
                result = self._script(self._robot)
            self.outcome.set_result(result)
        except BaseException as error:  # raised again by run_together
            self.outcome.set_exception(error)
        finally:
            self._paused.release()
