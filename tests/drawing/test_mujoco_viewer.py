"""MuJoCo's viewer on a run: it shows the run without any effect on it. A fake replaces the window."""

# MuJoCo's rendering is not typed here.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false
# pyright: reportAttributeAccessIssue=false

import contextlib
import os
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from typer.testing import CliRunner

from khep_twin.cli.app import app
from khep_twin.drawing import mujoco_viewer
from khep_twin.drawing.mujoco_viewer import MujocoViewer
from khep_twin.errors import KhepTwinError
from khep_twin.playpen import Playpen
from khep_twin.playpen_to_mjcf import to_spec
from khep_twin.world import World


class Window:
    """A window that records its frames, and whose user modifies model and state."""

    def __init__(self, model: mujoco.MjModel, data: mujoco.MjData, **_: Any) -> None:
        self.model, self.data, self.cam = model, data, mujoco.MjvCamera()
        self.pictures: list[tuple[float, float]] = []
        self.lamps: list[float] = []
        self.open = True

    def is_running(self) -> bool:
        return self.open

    def lock(self) -> contextlib.AbstractContextManager[None]:
        return contextlib.nullcontext()

    def sync(self) -> None:
        self.pictures.append(
            (self.data.body("khepera0/base").xpos[0], self.data.body("khepera0/base").xpos[1])
        )
        self.lamps.append(float(self.model.site_rgba[0, 0]))
        self.data.qpos += 1
        self.data.xfrc_applied += 5
        self.model.opt.timestep = 1

    def close(self) -> None:
        self.open = False


@pytest.fixture
def windows(monkeypatch: pytest.MonkeyPatch) -> list[Window]:
    opened: list[Window] = []

    def launch(model: mujoco.MjModel, data: mujoco.MjData, **options: Any) -> Window:
        opened.append(Window(model, data, **options))
        return opened[-1]

    pytest.importorskip("mujoco.viewer")
    monkeypatch.setattr("mujoco.viewer.launch_passive", launch)
    monkeypatch.setattr(mujoco_viewer, "check_screen", lambda *_: None)
    monkeypatch.setattr(mujoco_viewer, "FRAME_NS", 0)
    return opened


def test_a_run_with_the_viewer_is_bit_for_bit_the_run_without(tmp_path: Path, windows: list[Window]) -> None:
    words = ["run", "braitenberg", "--playpen", "obstacles", "--seconds", "0.4", "--log"]
    logs = [tmp_path / "with.mcap", tmp_path / "without.mcap"]
    for log, options in zip(logs, (["--viewer"], []), strict=True):
        result = CliRunner().invoke(app, [*words, str(log), *options])
        assert result.exit_code == 0, result.output
    assert logs[0].read_bytes() == logs[1].read_bytes()
    (window,) = windows
    assert len(window.pictures) >= 20
    assert window.pictures[-1] != window.pictures[0]
    assert not window.open


def test_a_series_of_new_twins_has_one_window(windows: list[Window]) -> None:
    words = [
        "run",
        "--playpen",
        "default",
        "--cycles",
        "3",
        "--runs",
        "2",
        "--start",
        "100,100,0",
        "--viewer",
    ]
    result = CliRunner().invoke(app, [*words, "--start", "400,400,0"])
    assert result.exit_code == 0, result.output
    (window,) = windows
    places = np.round(np.array(window.pictures) * 10)
    assert places[0].tolist() == [1, 1]
    assert places[-1].tolist() == [4, 4]


def test_closing_waits_until_nothing_is_drawn(windows: list[Window], monkeypatch: pytest.MonkeyPatch) -> None:
    drawn: list[str] = []

    def launch(*arguments: Any, **options: Any) -> Window:
        window = Window(*arguments, **options)

        def draw() -> None:
            while window.open:
                time.sleep(0.01)
            time.sleep(0.1)  # the last picture
            drawn.append("last")

        threading.Thread(target=draw, daemon=True).start()
        return window

    monkeypatch.setattr("mujoco.viewer.launch_passive", launch)
    viewer = MujocoViewer(real_time=False)
    viewer.watch(World(Playpen.load("default")))
    viewer.close()
    assert drawn == ["last"]


def test_a_lamp_that_is_off_is_dark(windows: list[Window]) -> None:
    world = World(Playpen.load("two-lamps"))
    MujocoViewer(real_time=False).watch(world)
    bright = windows[0].lamps[-1]
    world.lamps.switch(0, is_on=False, time_ns=0)
    world.advance_to(100_000_000)
    assert windows[0].lamps[-1] < bright / 2


def test_a_run_goes_on_when_its_window_is_closed(windows: list[Window]) -> None:
    world = World(Playpen.load("default"))
    MujocoViewer(real_time=True).watch(world)
    windows[0].close()
    world.advance_to(10**12 // 100)
    assert len(windows[0].pictures) <= 1


def test_on_macos_the_viewer_without_mjpython_is_refused_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.platform", "darwin")
    with pytest.raises(
        KhepTwinError, match=r"^--viewer: this is python, expected mjpython -m khep_twin"
    ) as error:
        MujocoViewer(real_time=False)
    assert len(str(error.value).splitlines()) == 1


@pytest.mark.share(2)
@pytest.mark.parametrize("words", [["run"], ["serve"]])
def test_without_a_screen_one_line_says_what_is_expected(words: list[str], tmp_path: Path) -> None:
    environment = {key: text for key, text in os.environ.items() if "DISPLAY" not in key}
    if sys.platform != "linux":
        pytest.skip("other systems have a screen")
    process = subprocess.run(
        [sys.executable, "-m", "khep_twin", *words, "--viewer"],
        env=environment,
        cwd=tmp_path,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert process.returncode == 1
    (line,) = process.stderr.splitlines()
    assert line.startswith("khep-twin: --viewer: DISPLAY is not set, expected a desktop")
    assert process.stdout == ""


def test_a_compiled_playpen_opens_without_the_rays_of_its_rangefinders() -> None:
    model = to_spec(Playpen.load("obstacles")).compile()
    assert model.vis.rgba.rangefinder[3] == 0
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    scene = mujoco.MjvScene(model, maxgeom=1000)
    option = mujoco.MjvOption()
    option.flags[mujoco.mjtVisFlag.mjVIS_RANGEFINDER] = 1
    mujoco.mjv_updateScene(model, data, option, None, mujoco.MjvCamera(), mujoco.mjtCatBit.mjCAT_ALL, scene)
    rays = [geom for geom in scene.geoms[: scene.ngeom] if geom.type == mujoco.mjtGeom.mjGEOM_LINE]
    assert all(geom.rgba[3] == 0 for geom in rays)
