"""Control algorithms in the Khepera Toolbox's own form, a function with its own loops, as a controller.

    def brait(port_id, cycles_per_run, runs, pause_stat):
        run_count = 0
        while run_count < runs:
            cycle_count = 0
            while cycle_count < cycles_per_run:
                motors = rps(port_id) @ Intercon / 400 + speed
                sms(port_id, motors[0], motors[1])
                cycle_count = cycle_count + 1
            run_count = run_count + 1
        sms(port_id, 0, 0)

The function is called once for each run, with `runs` = 1 and `pause_stat` = 0, so that a run is measured,
kept and followed by a pause as any other controller's. Variables that persist between runs are global,
as in the toolbox.
"""

import sys
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from types import CodeType, FrameType, FunctionType
from typing import cast

from khep_twin.errors import ControllerError
from khep_twin.host import Khepera
from khep_twin.lab.experiment.controllers import LoopingController
from khep_twin.toolbox import serial_commands as host
from khep_twin.toolbox import simulator
from khep_twin.toolbox.simulator import OpenPlaypen

ARGUMENTS = ("port_id", "cycles_per_run", "runs", "pause_stat")
"""Arguments of such a function, in this order, by any name."""


class ToolboxController(LoopingController):
    """A function of `ARGUMENTS`, unpaced if it drives by `sim_` commands and `kheprom`, not through a port.

    Its variables are all that it has when it returns: its own, the global ones that it names, and what it
    returns.
    """

    passes_time = "kheprom(btmap1) in each cycle of a simulated robot, or a command to a real one"

    def __init__(self, function: Callable[..., object]) -> None:
        super().__init__(function)
        open_ones = [each for each in function.__globals__.values() if isinstance(each, OpenPlaypen)]
        self.playpen = open_ones[0].twin.world.playpen if open_ones else None
        self.unpaced = _names_the_simulator(function, set())

    def loop(
        self, robot: Khepera, cycles: int, end_cycle: Callable[[], bool], stop: Callable[[], bool]
    ) -> int | None:
        """Call the function for one run."""
        function: Callable[..., object] = self.function
        run = _Run(robot, function.__code__, end_cycle, stop)
        run.heard_by = robot.listen(run.on_reply)
        try:
            with simulator.opened_for(robot) as btmap1, host.assigned_port(robot, self.port_id) as port_id:
                if self.unpaced and btmap1 is None:
                    raise ControllerError(
                        f"{function.__name__}: drives by sim_ commands, not through {robot.name}; "
                        "expected a twin in this process, or a function without sim_ and kheprom"
                    )
                with _open_for(function, btmap1):
                    returned = function(port_id, _Cycles(cycles, run), 1, 0)
        except _Stopped:
            return None
        finally:
            robot.listen(run.heard_by)
        if not run.counts and run.ended == robot.time:
            end_cycle()  # which reports that no time has passed
        names = function.__globals__
        named = {name: names[name] for name in function.__code__.co_names if name in names}
        self._returned = {**named, **run.variables(), **_returned(returned)}
        return run.count if run.counts else cycles


class _Stopped(BaseException):
    """Request to end the series, raised though the function is in the middle of its run."""


class _Run:
    """One run of a function: its cycles, and its variables afterwards."""

    def __init__(
        self, robot: Khepera, code: CodeType, end_cycle: Callable[[], bool], stop: Callable[[], bool]
    ) -> None:
        self._robot, self._code, self._end_cycle, self._stop = robot, code, end_cycle, stop
        self._frame: FrameType | None = None
        self.heard_by: Callable[[str, str], None] | None = None
        self.counts = False
        self.count = 0
        self.ended = robot.time

    def compare(self, count: int, cycles: int) -> None:
        """Note that the function compares its count of cycles with their number."""
        self._find_frame()
        if self.counts and count > self.count:
            self._end_cycle()
        if self._stop() and count < cycles:
            raise _Stopped
        self.counts, self.count = True, int(count)

    def on_reply(self, request: str, reply: str) -> None:
        """Pass an exchange on; a function that does not count by `compare` ends a cycle with each speed."""
        if self.heard_by is not None:
            self.heard_by(request, reply)
        self._find_frame()
        if self._stop():
            raise _Stopped
        if not self.counts and request.startswith("D,") and self._robot.time != self.ended:
            self.ended = self._robot.time
            self._end_cycle()

    def variables(self) -> dict[str, object]:
        """Return the function's own variables as of its end."""
        held = {} if self._frame is None else dict(self._frame.f_locals)
        arguments = self._code.co_varnames[: len(ARGUMENTS)]
        return {name: value for name, value in held.items() if name not in arguments}

    def _find_frame(self) -> None:
        """Keep the function's frame: it has the variables even when the function has returned."""
        frame = sys._getframe() if self._frame is None else None  # pyright: ignore[reportPrivateUsage]
        while frame is not None and frame.f_code is not self._code:
            frame = frame.f_back
        self._frame = self._frame or frame


class _Cycles(int):
    """The number of cycles in a run; it notices each `cycle_count < cycles_per_run`."""

    def __new__(cls, number: int, run: _Run) -> "_Cycles":
        return super().__new__(cls, number)

    def __init__(self, number: int, run: _Run) -> None:
        self._run = run

    # Python asks the other side of a comparison first if that is a subclass.
    def __gt__(self, count: int) -> bool:
        self._run.compare(count, int(self))
        return int(self) > count

    def __ge__(self, count: int) -> bool:
        self._run.compare(count - 1, int(self))
        return int(self) >= count


@contextmanager
def _open_for(function: Callable[..., object], btmap1: OpenPlaypen | None) -> Generator[None]:
    """Open `btmap1`, and other playpens among a function's globals, within the context."""
    names = function.__globals__
    before = {name: value for name, value in names.items() if isinstance(value, OpenPlaypen)}
    names.update(dict.fromkeys({*before, "btmap1"}, btmap1))
    try:
        yield
    finally:
        names.pop("btmap1", None)
        names.update(before)


def _names_the_simulator(function: Callable[..., object], seen: set[CodeType]) -> bool:
    """Return whether a function, or one that it calls in its own file, names a simulated command."""
    code = function.__code__
    if code in seen:
        return False
    seen.add(code)
    if any(name == "kheprom" or name.startswith("sim_") for name in code.co_names):
        return True
    called = [function.__globals__.get(name) for name in code.co_names]
    functions = [each for each in called if isinstance(each, FunctionType)]
    own = [each for each in functions if each.__module__ == function.__module__]
    return any(_names_the_simulator(each, seen) for each in own)


def _returned(value: object) -> Mapping[str, object]:
    """Return what a function returns by name: as it names them, or var1, var2, ... as the manual has it."""
    if isinstance(value, Mapping):
        mapping = cast(Mapping[object, object], value)
        return {str(name): each for name, each in mapping.items()}
    if value is None:
        return {}
    several = cast(tuple[object, ...], value) if isinstance(value, tuple) else (value,)
    return {f"var{number}": each for number, each in enumerate(several, 1)}
