"""RoboRunner: controllers in the toolbox's form, their statistics, and its windows."""

import os
import signal
import subprocess
import sys
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from forked import Forked
from scipy.io import loadmat

from khep_twin import toolbox
from khep_twin.errors import ControllerError, KhepTwinError, PlaypenError
from khep_twin.lab.experiment.series_run import SeriesRun
from khep_twin.toolbox import kheprom, roborunner, rps, sim_rps, sim_sms, sms
from khep_twin.toolbox import serial_commands as host

n_calls = 0


def brait(port_id: int, cycles_per_run: int, runs: int, pause_stat: float) -> tuple[int, list[int]]:
    """Wander, with a constant port number in one command, as in the manual's first version."""
    global n_calls
    run_count = 0
    near = 0
    while run_count < runs:
        cycle_count = 0
        while cycle_count < cycles_per_run:
            front = rps(2)[2:4]
            near += int(max(front) > 100)
            speeds = [6, 6] if max(front) < 100 else [-3, 3]
            sms(port_id, *speeds)
            cycle_count = cycle_count + 1
        run_count = run_count + 1
    n_calls += 1
    sms(port_id, 0, 0)
    return near, speeds


def simsamp(port_id: int, cycles_per_run: int, runs: int, pause_stat: float) -> None:
    for _run in range(runs):
        for _cycle in range(cycles_per_run):
            sim_sms(2, 5, 5)
            if any(sim_rps(2) > 900):
                sim_sms(2, -5, 5)
            kheprom(btmap1)  # type: ignore[name-defined]  # noqa: F821


@pytest.fixture(autouse=True)
def reset_count(no_screen: None) -> None:
    global n_calls
    n_calls = 0


def test_a_function_is_run_at_a_port_and_its_variables_are_kept_and_handed_on(
    capsys: pytest.CaptureFixture[str],
) -> None:
    values: list[Any] = []

    def user2(near: int, speeds: Any) -> None:
        values.append((near, speeds.tolist()))

    runs = toolbox.roborun2(
        brait,
        port_id="khep://obstacles?seed=1",
        cycles_per_run=60,
        runs=2,
        pause=1.5,
        save="kept",
        user=user2,
    )
    assert [run.number for run in runs] == [1, 2]
    assert [run.cycles for run in runs] == [60, 60]
    assert values == [(run.variables["near"], run.variables["speeds"].tolist()) for run in runs]
    first = loadmat("kept/run-001.mat")
    assert first["near"].item() == first["var1"].item() == runs[0].variables["near"]
    assert first["cycle_count"].item() == 60
    # Global variables persist between runs.
    assert [run.variables["n_calls"] for run in runs] == [1, 2]
    assert runs[0].metrics["speed_mean"] > 3
    assert capsys.readouterr().out.count("60 cycles in") == 2


def test_a_function_for_the_simulator_is_run_in_the_playpen_that_is_open() -> None:
    btmap1 = toolbox.open_default(seed=1)
    toolbox.putkhep(300, 440, 90)
    (run,) = toolbox.roborun2(simsamp, cycles_per_run=100)
    assert btmap1.time == run.duration == 5
    assert run.cycles == 100
    assert run.metrics["proximity_max"] > 900
    assert "btmap1" not in globals()


def test_the_statistics_of_the_latest_runs_are_printed_drawn_and_saved(
    capsys: pytest.CaptureFixture[str],
) -> None:
    toolbox.open_default(seed=1)
    toolbox.roborun2(simsamp, cycles_per_run=20, runs=3, save="kept", user=toolbox.user1)
    statistics = toolbox.getstat()
    assert statistics["fitness"].count == 3
    assert statistics == toolbox.getstat(runs="kept")
    assert "fitness" in capsys.readouterr().out
    figure = toolbox.plotrun("fitness", picture="runs.png")
    assert figure.axes[0].get_ylabel() == "fitness"
    assert Path("runs.png").exists()
    toolbox.user1(save="runs.mat")
    assert loadmat("runs.mat")["fitness"].shape == (3, 1)
    with pytest.raises(KhepTwinError, match=r"save = 'runs.txt': expected a name that ends in \.csv"):
        toolbox.user1(save="runs.txt")


def test_the_template_is_run_as_it_stands() -> None:
    assert toolbox.template("mine.py") == Path("mine.py")
    (run,) = toolbox.roborun2("mine.py", port_id="khep://default", cycles_per_run=30)
    assert run.variables["motors"].shape == (2,)
    with pytest.raises(ControllerError, match="is there already"):
        toolbox.template("mine.py")


def failing(port_id: int, cycles_per_run: int, runs: int, pause_stat: float) -> None:
    rps(port_id)
    raise ZeroDivisionError("in its middle")


def waiting(port_id: int, cycles_per_run: int, runs: int, pause_stat: float) -> None:
    cycle_count = 0
    while cycle_count < cycles_per_run:
        sim_sms(1, 1, 1)
        cycle_count = cycle_count + 1


@pytest.mark.parametrize(
    ("call", "error", "message"),
    [
        (lambda: toolbox.roborun2(brait), ControllerError, "no port_id is given; expected 1 to 4"),
        (lambda: toolbox.roborun2(simsamp), PlaypenError, "no playpen is open"),
        (lambda: toolbox.roborun2("none.py"), ControllerError, "none.py: no such file"),
        (
            lambda: toolbox.roborun2(failing, port_id="khep://default"),
            ControllerError,
            r"test_toolbox_roborunner.py:\d+: ZeroDivisionError: in its middle",
        ),
        (
            lambda: (toolbox.open_default(), toolbox.roborun2(waiting, cycles_per_run=2)),
            ControllerError,
            r"waiting: a cycle lets no time pass; expected kheprom\(btmap1\)",
        ),
        (toolbox.getstat, ControllerError, "there are no runs yet; expected roborun2 before"),
        (lambda: toolbox.template("mine.m"), ControllerError, "expected a name that ends in .py"),
    ],
)
def test_what_cannot_be_run_is_one_line(call: Callable[[], object], error: type, message: str) -> None:
    with pytest.raises(error, match=message) as caught:
        call()
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("port", [2, "khep://default"])
def test_a_controller_has_the_number_of_its_robot_and_1_for_a_port(port: int | str) -> None:
    numbers: list[int] = []

    def note(port_id: int, cycles_per_run: int, runs: int, pause_stat: float) -> None:
        numbers.append(port_id)
        brait(port_id, cycles_per_run, runs, pause_stat)

    host.ports({2: "khep://default"})
    toolbox.roborun2(note, port_id=port, cycles_per_run=2)
    assert numbers == [port if isinstance(port, int) else 1]


def test_an_interrupt_stops_the_motors_and_leaves_the_runs_before_it() -> None:
    host.ports({2: "khep://default"})

    def interrupt(run: SeriesRun) -> None:
        if run.number == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        toolbox.roborun2(brait, port_id=2, cycles_per_run=20, runs=9, user=interrupt)
    assert toolbox.getstat()["fitness"].count == 2
    host.robot_at(2).sleep(1)
    assert host.robot_at(2).speed() == (0, 0)


def test_without_an_algorithm_its_window_is_the_page_of_play_pen(monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[str] = []
    monkeypatch.setattr(roborunner, "play_pen", lambda: opened.append("page"))
    assert toolbox.roborun2() == []
    assert opened == ["page"]


def test_play_pen_is_the_designers_page_until_it_is_interrupted(tmp_path: Path) -> None:
    program = "from khep_twin.toolbox import play_pen\nplay_pen('new.toml')\nprint('on with it')"
    environment = os.environ | {"BROWSER": "true"}
    with Forked(
        [sys.executable, "-c", program], stdout=subprocess.PIPE, cwd=tmp_path, env=environment, text=True
    ) as process:
        assert process.stdout is not None
        url = process.stdout.readline().strip()
        with urllib.request.urlopen(url, timeout=60) as page:
            assert page.status == 200
        process.send_signal(signal.SIGINT)
        assert process.stdout.read() == "on with it\n"
    assert process.returncode == 0
