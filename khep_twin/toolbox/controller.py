"""Controllers in the Khepera Toolbox's form: a function that contains the loops over runs and cycles.

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

The function is called once for each run, with `runs` = 1 and `pause_stat` = 0, so that its runs are measured,
saved and separated by pauses like those of other controllers. Variables that persist between runs are
global, as in the toolbox.
"""

import sys
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from types import CodeType, FrameType, FunctionType
from typing import cast

from khep_twin.errors import ControllerError
from khep_twin.host import Khepera
from khep_twin.lab.experiment.controllers import LoopingController
from khep_twin.toolbox import simulator
from khep_twin.toolbox.serial_commands import assigned_port
from khep_twin.toolbox.simulator import OpenPlaypen

ARGUMENTS = ("port_id", "cycles_per_run", "runs", "pause_stat")
"""Arguments of a controller function, in this order, under any names."""


class ToolboxController(LoopingController):
    """A function of `ARGUMENTS`, unpaced if it drives by `sim_` commands and `kheprom`, not through a port.

    Its variables are its local and global variables when it returns, and its return values.
    """

    passes_time = "kheprom(btmap1) in each cycle of a simulated robot, or a command to a real one"

    def __init__(self, function: Callable[..., object]) -> None:
        super().__init__(function)
        open_playpens = [value for value in function.__globals__.values() if isinstance(value, OpenPlaypen)]
        self.playpen = open_playpens[0].twin.world.playpen if open_playpens else None
        self.unpaced = _uses_simulator(function, set())

    def loop(
        self, robot: Khepera, cycles: int, end_cycle: Callable[[], bool], stop: Callable[[], bool]
    ) -> int | None:
        """Call the function for one run; return its number of cycles, None if the series was stopped."""
        function: Callable[..., object] = self.function
        run = _Run(robot, function.__code__, end_cycle, stop)
        run.listener = robot.listen(run.on_reply)
        try:
            with simulator.use_twin_of(robot) as btmap1, assigned_port(robot, self.port_id) as port_id:
                if self.unpaced and btmap1 is None:
                    raise ControllerError(
                        f"{function.__name__}: drives by sim_ commands, not through {robot.name}; "
                        "expected a twin in this process, or a function without sim_ and kheprom"
                    )
                with _bind_open_playpen(function, btmap1):
                    returned = function(port_id, _CycleCount(cycles, run), 1, 0)
        except _StopSeries:
            return None
        finally:
            robot.listen(run.listener)
        if not run.has_counter and run.cycle_end_s == robot.time:
            end_cycle()  # reports that no time has passed
        scope = function.__globals__
        global_variables = {name: scope[name] for name in function.__code__.co_names if name in scope}
        self._returned = {**global_variables, **run.variables(), **_name_values(returned)}
        return run.count if run.has_counter else cycles


class _StopSeries(BaseException):
    """Request to end the series, raised within the function's run."""


class _Run:
    """One run of a function: its cycles, and its variables afterwards."""

    def __init__(
        self, robot: Khepera, code: CodeType, end_cycle: Callable[[], bool], stop: Callable[[], bool]
    ) -> None:
        self._robot = robot
        self._code = code
        self._end_cycle = end_cycle
        self._stop = stop
        self._frame: FrameType | None = None
        self.listener: Callable[[str, str], None] | None = None
        self.has_counter = False
        self.count = 0
        self.cycle_end_s = robot.time

    def on_comparison(self, count: int, cycles: int) -> None:
        """Record that the function compares its cycle count with the number of cycles."""
        self._find_frame()
        if self.has_counter and count > self.count:
            self._end_cycle()
        if self._stop() and count < cycles:
            raise _StopSeries
        self.has_counter, self.count = True, int(count)

    def on_reply(self, request: str, reply: str) -> None:
        """Pass an exchange to the listener; without `on_comparison`, each speed command ends a cycle."""
        if self.listener is not None:
            self.listener(request, reply)
        self._find_frame()
        if self._stop():
            raise _StopSeries
        if not self.has_counter and request.startswith("D,") and self._robot.time != self.cycle_end_s:
            self.cycle_end_s = self._robot.time
            self._end_cycle()

    def variables(self) -> dict[str, object]:
        """Return the function's local variables at its end."""
        values = {} if self._frame is None else dict(self._frame.f_locals)
        arguments = self._code.co_varnames[: len(ARGUMENTS)]
        return {name: value for name, value in values.items() if name not in arguments}

    def _find_frame(self) -> None:
        """Keep the function's frame, which holds the variables after its return."""
        frame = sys._getframe() if self._frame is None else None  # pyright: ignore[reportPrivateUsage]
        while frame is not None and frame.f_code is not self._code:
            frame = frame.f_back
        self._frame = self._frame or frame


class _CycleCount(int):
    """The number of cycles in a run; it reports each `cycle_count < cycles_per_run`."""

    def __new__(cls, number: int, run: _Run) -> "_CycleCount":
        return super().__new__(cls, number)

    def __init__(self, number: int, run: _Run) -> None:
        self._run = run

    # Python calls the right operand's method first if its type is a subclass.
    def __gt__(self, count: int) -> bool:
        self._run.on_comparison(count, int(self))
        return int(self) > count

    def __ge__(self, count: int) -> bool:
        self._run.on_comparison(count - 1, int(self))
        return int(self) >= count


@contextmanager
def _bind_open_playpen(function: Callable[..., object], btmap1: OpenPlaypen | None) -> Generator[None]:
    """Open `btmap1`, and other playpens among a function's globals, within the context."""
    scope = function.__globals__
    saved = {name: value for name, value in scope.items() if isinstance(value, OpenPlaypen)}
    scope.update(dict.fromkeys({*saved, "btmap1"}, btmap1))
    try:
        yield
    finally:
        scope.pop("btmap1", None)
        scope.update(saved)


def _uses_simulator(function: Callable[..., object], visited: set[CodeType]) -> bool:
    """Return whether a function, or one that it calls in the same module, uses a simulated command."""
    code = function.__code__
    if code in visited:
        return False
    visited.add(code)
    if any(name == "kheprom" or name.startswith("sim_") for name in code.co_names):
        return True
    globals_used = [function.__globals__.get(name) for name in code.co_names]
    functions = [value for value in globals_used if isinstance(value, FunctionType)]
    local_functions = [called for called in functions if called.__module__ == function.__module__]
    return any(_uses_simulator(called, visited) for called in local_functions)


def _name_values(value: object) -> Mapping[str, object]:
    """Return a function's return values by name: keys of a mapping, or var1, var2, ... as in the manual."""
    if isinstance(value, Mapping):
        mapping = cast(Mapping[object, object], value)
        return {str(name): item for name, item in mapping.items()}
    if value is None:
        return {}
    items = cast(tuple[object, ...], value) if isinstance(value, tuple) else (value,)
    return {f"var{number}": item for number, item in enumerate(items, 1)}
