"""Runs in series."""

from itertools import pairwise
from pathlib import Path

import pytest

from khep_twin.board.kernel import SETPOINTS
from khep_twin.errors import ControllerError
from khep_twin.host import Khepera
from khep_twin.lab.experiment.controllers import Controller, braitenberg
from khep_twin.lab.experiment.series import FreshTwins, OneRobot, run_series
from khep_twin.lab.experiment.series_run import Plan, SeriesRun, numbered_path
from khep_twin.lab.experiment.start_poses import StartPose
from khep_twin.playpen import Playpen
from khep_twin.ports.twin import Twin, TwinOptions

DEFAULT, OBSTACLES = Playpen.load("default"), Playpen.load("obstacles")


class Places(Controller):
    """Records when each of its methods is called."""

    def __init__(self) -> None:
        self.runs = 0
        self._calls: list[str] = []

    def start(self, robot: Khepera) -> None:
        self.runs += 1
        self._calls.append("start")

    def cycle(self, robot: Khepera) -> None:
        robot.set_speed(5, 5)
        self._calls.append("cycle")

    def end(self, robot: Khepera) -> None:
        assert robot.speed() is not None
        self._calls.append("end")

    def stop(self, robot: Khepera) -> None:
        self._calls.append("stop")


def test_a_controllers_methods_are_called_in_their_order_and_it_keeps_what_it_learned() -> None:
    places = Places()
    with Khepera("khep://default") as robot:
        runs = list(run_series(places, OneRobot(robot), Plan(2, cycles=2)))
    assert places._calls == ["start", "cycle", "cycle", "end"] * 2 + ["stop"]
    assert [run.variables for run in runs] == [{"runs": 1}, {"runs": 2}]
    assert [run.number for run in runs] == [1, 2]


def test_one_robot_goes_on_and_new_twins_begin_anew() -> None:
    with Khepera("khep://obstacles?noise=off") as robot:
        first, second = run_series(braitenberg, OneRobot(robot), Plan(2, cycles=40))
    assert first.start is second.start is None
    assert first.metrics != second.metrics
    source = FreshTwins(
        OBSTACLES, TwinOptions(noise=False), [StartPose(400, 300, 90), StartPose(120, 290, 25)]
    )
    runs = list(run_series(braitenberg, source, Plan(4, cycles=40)))
    assert [str(run.start) for run in runs] == ["400,300,90", "120,290,25"] * 2
    assert runs[0].metrics == runs[2].metrics != runs[1].metrics == runs[3].metrics == first.metrics
    assert runs[2:] == list(run_series(braitenberg, source, Plan(4, cycles=40), first=3))


def test_each_new_twin_has_a_seed_of_its_own() -> None:
    seeds: list[int] = []

    def record(twin: Twin, number: int) -> None:
        seeds.append(twin.options.seed)

    source = FreshTwins(DEFAULT, TwinOptions(seed=7), [StartPose(300, 250, 0)], record)
    list(run_series(braitenberg, source, Plan(3, cycles=1)))
    assert seeds == [7, 8, 9]


def test_the_pause_lies_between_runs_only() -> None:
    times: list[float] = []
    with Khepera("khep://default") as robot:
        plan = Plan(3, cycles=1, pause=2.05)
        list(
            run_series(braitenberg, OneRobot(robot), plan, before_run=lambda number: times.append(robot.time))
        )
    assert times[0] < 0.01
    assert [round(later - before, 1) for before, later in pairwise(times)] == [2.1, 2.1]


def test_a_series_that_is_stopped_leaves_a_robot_that_stands_and_no_broken_run() -> None:
    places = Places()
    with Khepera("khep://default") as robot:

        def stop() -> bool:
            return places._calls.count("cycle") >= 5

        broken: list[SeriesRun] = []
        series = run_series(places, OneRobot(robot), Plan(4, cycles=3), stop=stop, on_abort=broken.append)
        runs = list(series)
        assert robot.port.twin.robot.registers[SETPOINTS].tolist() == [0, 0]
    assert len(runs) == 1
    assert [(run.number, run.cycles) for run in broken] == [(2, 2)]
    assert broken[0].duration > 0
    assert places._calls[-2:] == ["end", "stop"]


def test_a_stop_in_the_pause_begins_no_run() -> None:
    places = Places()
    with Khepera("khep://default") as robot:
        plan = Plan(2, cycles=2, pause=1000)
        runs = list(run_series(places, OneRobot(robot), plan, stop=lambda: robot.time > 1))
        assert robot.time < 2
    assert [run.number for run in runs] == [1]
    assert places._calls == ["start", "cycle", "cycle", "end", "stop"]


def test_a_method_that_fails_is_reported_and_the_controller_is_stopped() -> None:
    class Fails(Places):
        def end(self, robot: Khepera) -> None:
            raise ZeroDivisionError("of its own")

    places = Fails()
    with Khepera("khep://default") as robot:
        with pytest.raises(ControllerError, match=r"test_series.py:\d+: ZeroDivisionError: of its own"):
            list(run_series(places, OneRobot(robot), Plan(2, cycles=1)))
        assert robot.port.twin.robot.registers[SETPOINTS].tolist() == [0, 0]
    assert places._calls[-1] == "stop"


def test_a_series_that_is_given_up_stops_its_controller() -> None:
    places = Places()
    with Khepera("khep://default") as robot:
        series = run_series(places, OneRobot(robot), Plan(2, cycles=1))
        next(series)
        series.close()
    assert places._calls == ["start", "cycle", "end", "stop"]


def test_where_a_series_goes_on() -> None:
    new = FreshTwins(DEFAULT, TwinOptions(), [StartPose(300, 250, 0)])
    with Khepera("khep://default") as robot:
        assert OneRobot(robot).first_run(3, braitenberg) == 1
    # A function is assumed to be repeatable; the last run is repeated as a check.
    assert [new.first_run(n_saved, braitenberg) for n_saved in (0, 1, 3)] == [1, 1, 3]
    assert new.first_run(3, Places()) == 1


@pytest.mark.parametrize(
    ("values", "line"),
    [
        ({"runs": 0, "cycles": 1}, "0 runs of 1 cycles; expected numbers above 0"),
        ({"cycles": 0}, "expected numbers above 0"),
        ({}, "a run needs an end"),
        ({"seconds": float("nan")}, "runs of nan s; expected a time above 0"),
        ({"seconds": 1, "pause": -1}, "a pause of -1 s; expected 0 or more"),
        ({"seconds": 1, "pause": float("inf")}, "a pause of inf s"),
    ],
)
def test_what_is_no_series_is_refused(values: dict[str, float], line: str) -> None:
    with pytest.raises(ControllerError, match=line):
        Plan(**values)  # type: ignore[arg-type]


def test_a_series_needs_a_start() -> None:
    with pytest.raises(ControllerError, match="needs a start"):
        FreshTwins(DEFAULT, TwinOptions(), [])


def test_runs_have_files_of_their_own() -> None:
    assert numbered_path(Path("a/run.mcap"), 7) == Path("a/run-007.mcap")
    assert isinstance(SeriesRun(1, None, 1, 1.0, {}).variables, dict)
