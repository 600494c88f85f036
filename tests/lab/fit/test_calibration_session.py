"""Calibration sessions: placing and measuring by a person, saved steps, and aborts without loss."""

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import scenes
from scenes import arena, hosted, table

from khep_twin import playpen
from khep_twin.errors import FitError
from khep_twin.host import Khepera
from khep_twin.lab.fit.fit_inputs import fit_inputs
from khep_twin.lab.fit.motor_fit import read_drive
from khep_twin.lab.fit.placement import Ruler
from khep_twin.lab.fit.session import WORDS_FILE, CalibrationSession
from khep_twin.lab.fit.session_people import PersonAtTerminal, SimulatedPerson
from khep_twin.lab.fit.session_steps import Step, record, steps

BENCH = arena(1000, 1000) + scenes.robot(500, 500)
CYLINDER = table("cylinder", x_mm=200, y_mm=200, radius_mm=10, height_mm=50)
STRAIGHT, DUTY, WALL = Step("straight"), Step("duty"), Step("wall", 15.0)


def bench(log: Path | None = None, text: str = BENCH) -> Khepera:
    return hosted(playpen.parse(text, "bench"), log=log and str(log))


def never() -> bool:
    return False


def simulated(robot: Khepera, ruler: Ruler | None = None) -> SimulatedPerson:
    return SimulatedPerson(robot.port.twin, ruler or Ruler(0, 0), lambda _: None)


def answering(*answers: str) -> tuple[PersonAtTerminal, list[str]]:
    """Return a person at a terminal with these answers, and the shown lines."""
    lines: list[str] = []
    rest = iter(answers)

    def ask(question: str) -> str:
        lines.append(question)
        return next(rest)

    return PersonAtTerminal(lines.append, ask), lines


def test_a_session_goes_on_after_the_last_step_that_was_done(tmp_path: Path) -> None:
    folder, lines = tmp_path / "session", list[str]()
    with bench() as robot:
        assert CalibrationSession(folder).run([STRAIGHT], robot, simulated(robot), lines.append, never)
        before = (folder / "straight.mcap").read_bytes()
        stops = iter([False] * 40)
        again = CalibrationSession(folder)
        assert not again.run(
            [STRAIGHT, WALL, DUTY], robot, simulated(robot), lines.append, lambda: next(stops, True)
        )
        # The motors are stopped, and no partial recording exists.
        robot.sleep(0.5)
        assert robot.speed() == (0, 0)
        assert sorted(path.name for path in folder.iterdir()) == ["straight.mcap", WORDS_FILE]
        assert any("done before: straight.mcap=" in line for line in lines)
        third = CalibrationSession(folder)
        assert third.run([STRAIGHT, DUTY], robot, simulated(robot), lines.append, never)
    assert (folder / "straight.mcap").read_bytes() == before
    assert (folder / WORDS_FILE).read_text().splitlines() == third.words
    inputs = fit_inputs(third.words_with_folder)
    assert (len(inputs.wheels), len(inputs.motors)) == (1, 1)
    assert inputs.wheels[0].distance == pytest.approx(0.6, abs=0.001)


def test_a_recording_that_is_asked_to_stop_leaves_no_file(tmp_path: Path) -> None:
    with bench() as robot:
        for step in (STRAIGHT, DUTY, WALL):
            stops = iter([False] * 10)
            assert not record(robot, step, tmp_path / step.file_name, lambda stops=stops: next(stops, True))
    assert list(tmp_path.iterdir()) == []


def test_a_host_s_recording_has_the_times_of_the_twin_s_own_log(tmp_path: Path) -> None:
    with bench(tmp_path / "twin.mcap") as robot:
        assert record(robot, DUTY, tmp_path / "host.mcap", never)
    twin_drive, host = (read_drive(tmp_path / name) for name in ("twin.mcap", "host.mcap"))
    assert len(host.times_ns) > 300
    np.testing.assert_allclose(host.times_ns, twin_drive.times_ns[: len(host.times_ns)], atol=10)
    np.testing.assert_array_equal(host.values, twin_drive.values[: len(host.values)])


def test_a_simulated_person_puts_the_robot_where_the_step_wants_it_within_the_ruler_s_errors() -> None:
    with bench() as robot:
        twin = robot.port.twin
        exact = simulated(robot)
        assert exact.place(WALL) == 15.0
        assert twin.robot.pose[0] == pytest.approx(1.0 - 0.0275 - 0.015, abs=1e-6)
        lamp = Step("lamp", 60.0, power_w=2.0, height_mm=30.0)
        exact.place(lamp)
        (bulb,) = twin.world.playpen.lamps
        assert bulb.x_mm - twin.robot.pose[0] * 1e3 == pytest.approx(27.5 + 60 + 10, abs=0.01)
        assert (bulb.z_mm, bulb.power_w) == (30.0, 2.0)
        person, errors = simulated(robot, Ruler(0.5, 1.5)), list[tuple[float, float]]()
        for _ in range(60):
            person.place(WALL)
            x, _, heading = twin.robot.pose
            errors.append(((1.0 - 0.0275 - x) * 1e3 - 15, math.degrees(heading)))
        assert twin.world.playpen.lamps == ()
    np.testing.assert_allclose(np.std(errors, axis=0), [0.5, 1.5], rtol=0.3)


def test_turns_are_counted_whole_and_with_what_lies_beyond() -> None:
    with bench() as robot:
        person = simulated(robot)
        step = Step("turns")
        person.place(step)
        start = robot.port.twin.robot.pose[2]
        robot.set_speed(-10, 10)
        robot.sleep(1.0)
        robot.set_speed(0, 0)
        robot.sleep(0.5)
        beyond = (robot.port.twin.robot.pose[2] - start + math.pi) % (2 * math.pi) - math.pi
        assert person.measure(step) == pytest.approx(5 + beyond / 2 / math.pi, abs=1e-4)


@pytest.mark.parametrize(
    ("change", "problem"),
    [
        (("width_mm = 1000", "width_mm = 600"), "600 x 1000 mm"),
        (("height_mm = 1000\n", 'height_mm = 1000\nsurface = "black"\n'), "walls of black"),
        (("[[robot]]", f"{CYLINDER}[[robot]]"), "1 objects and other robots"),
    ],
)
def test_a_playpen_without_room_is_refused(change: tuple[str, str], problem: str) -> None:
    with bench(text=BENCH.replace(*change)) as robot, pytest.raises(FitError, match=problem):
        simulated(robot)


@pytest.mark.parametrize(
    ("step", "answers", "expected"),
    [
        (WALL, [""], 15.0),
        (WALL, ["14.5"], 14.5),
        (WALL, ["near", "-3", "nan", "s"], None),
        (STRAIGHT, ["700", ""], 0.0),
    ],
)
def test_a_place_is_confirmed_corrected_or_skipped(
    step: Step, answers: list[str], expected: float | None
) -> None:
    person, lines = answering(*answers)
    assert person.place(step) == expected
    assert lines[0] == step.instruction
    assert sum("expected Enter" in line for line in lines) == len(answers) - 1


@pytest.mark.parametrize(
    ("step", "answers", "expected"),
    [
        (STRAIGHT, ["598.5"], 598.5),
        (STRAIGHT, ["60", "598 mm", "601"], 601.0),
        (STRAIGHT, ["s"], None),
        (Step("turns"), ["4.93"], 4.93),
        (Step("turns"), ["5 -25"], 5 - 25 / 360),
        (Step("turns"), ["five", "5 x", "5"], 5.0),
    ],
)
def test_a_measurement_is_asked_for_until_it_is_a_number(
    step: Step, answers: list[str], expected: float | None
) -> None:
    person, _ = answering(*answers)
    assert person.measure(step) == expected


def test_a_person_who_has_put_everything_up_is_not_waited_for() -> None:
    def ask(question: str) -> str:
        raise AssertionError(question)

    assert PersonAtTerminal(lambda _: None, ask, wait=False).place(WALL) == 15.0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("wall-15.csv=wall@15mm\n", "expected a recording of"),
        ("../there.csv=wall@15mm\n", "expected a recording of"),
        ("what\n", "expected a recording of"),
    ],
)
def test_words_without_a_recording_are_refused(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / WORDS_FILE).write_text(text)
    with pytest.raises(FitError, match=message):
        CalibrationSession(tmp_path)


def test_a_file_is_no_folder(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(FitError, match="no directory"):
        CalibrationSession(tmp_path / "file")


@pytest.mark.parametrize(
    "make",
    [
        lambda: steps([0.0], None, None, 15),
        lambda: steps([10.0, 10.0], None, None, 15),
        lambda: steps([10.0], -2.0, None, 15),
        lambda: steps([10.0], None, 0.0, 15),
        lambda: steps([10.0], None, 2.0, math.nan),
    ],
)
def test_objects_that_no_one_has_are_refused(make: Callable[[], object]) -> None:
    with pytest.raises(FitError, match="expected"):
        make()


def test_every_step_has_a_file_and_a_word_of_its_own() -> None:
    session_steps = steps([6.0, 12.0], 27.0, 2.0, 15.0)
    assert len({step.file_name for step in session_steps}) == len(session_steps) == 10
    assert [step.make_word(12.5) for step in session_steps if step.kind in ("cylinder", "lamp")][::3] == [
        "cylinder-6.csv=cylinder:27mm@12.5mm",
        "lamp-60.csv=lamp:2W:15mm@12.5mm",
    ]
    assert {step.sign for step in session_steps if step.kind == "wall"} == {1, -1}


def test_a_session_takes_no_folder_of_others(tmp_path: Path) -> None:
    (tmp_path / STRAIGHT.file_name).write_text("a year's work")
    with pytest.raises(FitError, match=r"holds straight.mcap and no tests.txt; expected another folder"):
        CalibrationSession(tmp_path)
    with bench() as robot:
        assert not CalibrationSession(tmp_path / "new").run(
            [STRAIGHT], robot, simulated(robot), lambda _: None, lambda: True
        )
    assert CalibrationSession(tmp_path / "new").words == []
