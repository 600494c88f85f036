"""Controllers are edited in the page like playpens."""

import os
import time
from dataclasses import replace
from pathlib import Path

import pytest

from khep_twin.errors import KhepTwinError, PortError
from khep_twin.host.host_robot import open_robot
from khep_twin.lab.experiment.controller_files import find_controller
from khep_twin.lab.experiment.controllers import template_of
from khep_twin.lab.experiment.series import OneRobot, run_series
from khep_twin.lab.experiment.series_run import Plan
from khep_twin.playpen import Playpen
from khep_twin.ports.protocol_khep import Serial
from khep_twin.ports.twin import TwinOptions, open_twin
from khep_twin.web.documents import Documents, OutsideError, version_of
from khep_twin.web.drafts import draft_of
from khep_twin.web.file_actions import Programs
from khep_twin.web.server import Server
from khep_twin.web.session_actions import SessionActions
from tests.web.conftest import Client, Inbox

TEXT = "def controller(robot):\n    robot.set_speed(3, 3)  # ü\n"


def test_a_new_program_begins_with_the_template_and_is_saved(client: Client, tmp_path: Path) -> None:
    status, new = client.do("program", file="mine.py", model="khepera1")
    assert (status, new["version"]) == (200, None)
    assert "def cycle(self, robot: Khepera)" in new["text"]
    status, saved = client.do("save-program", file="mine.py", text=TEXT)
    assert (status, saved["version"]) == (200, version_of(TEXT))
    assert (tmp_path / "mine.py").read_text() == TEXT
    assert client.do("program", file="mine.py", model="khepera1")[1] == {
        "text": TEXT,
        "version": version_of(TEXT),
    }
    assert "mine.py" in client.do("list")[1]["programs"]


@pytest.mark.parametrize(("playpen", "robot"), [("arena4-two", 0), ("arena4-two", 2), ("arena3", 0)])
@pytest.mark.parametrize("is_shipped", [True, False])
def test_the_template_of_each_model_runs_as_it_stands(
    tmp_path: Path, playpen: str, robot: int, is_shipped: bool
) -> None:
    """Without a template, a robot drives straight ahead."""
    twin = open_twin(playpen, TwinOptions(robot=robot))
    model = twin.robot_model
    (tmp_path / "mine.py").write_text(template_of(model if is_shipped else replace(model, template="")))
    controller = find_controller(str(tmp_path / "mine.py"))
    with open_robot(model, Serial.of(twin, timeout=1.0)) as host:
        (run,) = run_series(controller, OneRobot(host), Plan(seconds=0.5))
    assert run.metrics["distance_m"] > 0.01


def test_a_template_of_an_unknown_model_is_refused(client: Client) -> None:
    status, reply = client.do("program", file="mine.py", model="khepera9")
    assert (status, reply["error"].startswith("model = 'khepera9': unknown")) == (400, True)


def test_a_program_that_was_changed_meanwhile_is_not_overwritten(client: Client, tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text("x = 1\n")
    version = client.do("program", file="mine.py", model="khepera1")[1]["version"]
    (tmp_path / "mine.py").write_text("x = 2\n")
    for base_version in (version, None):
        status, reply = client.do("save-program", file="mine.py", text=TEXT, version=base_version)
        assert (status, reply["conflict"]) == (409, True)
    assert (tmp_path / "mine.py").read_text() == "x = 2\n"
    assert client.do("save-program", file="mine.py", text=TEXT, version=version, overwrite=True)[0] == 200


@pytest.mark.parametrize("name", ["../x.py", "/tmp/x.py", "link.py", "mine.toml", ".x.py", "x", "pipe.py"])
def test_no_other_file_is_read_or_written(tmp_path: Path, name: str) -> None:
    (tmp_path / "in").mkdir()
    (tmp_path / "out.py").write_text("secret = 1\n")
    (tmp_path / "in" / "link.py").symlink_to(tmp_path / "out.py")
    os.mkfifo(tmp_path / "in" / "pipe.py")
    programs = Programs(Documents(tmp_path / "in"), True)
    with pytest.raises(KhepTwinError):
        programs.open(name, "khepera1")
    with pytest.raises(KhepTwinError):
        programs.save(name, TEXT, None, True)
    assert (tmp_path / "out.py").read_text() == "secret = 1\n"
    assert sorted(path.name for path in (tmp_path / "in").iterdir()) == ["link.py", "pipe.py"]


def test_what_is_no_text_is_refused_in_a_line(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_bytes(b"\xff\xfe")
    programs = Programs(Documents(tmp_path), True)
    with pytest.raises(KhepTwinError, match=r"mine.py: this is text in UTF-16; expected UTF-8"):
        programs.open("mine.py", "khepera1")
    (tmp_path / "mine.py").write_bytes(b"#" * 900_000)
    with pytest.raises(KhepTwinError, match=r"900000 bytes; expected at most"):
        programs.open("mine.py", "khepera1")


def test_a_page_for_other_machines_writes_no_programs(tmp_path: Path) -> None:
    server = Server(tmp_path, None, "0.0.0.0:0", allow_remote=True)
    server.listener.close()
    programs = server._page._files._programs  # pyright: ignore[reportPrivateUsage]
    with pytest.raises(OutsideError, match="writes no programs"):
        programs.save("mine.py", TEXT, None, False)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("before", ["", "def controller(robot):\n    "])
def test_a_program_without_an_end_is_left_after_a_stop_and_the_next_one_runs(
    inbox: Inbox, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, before: str
) -> None:
    """The endless loop is in the file or in a cycle."""
    monkeypatch.setattr("khep_twin.web.session._ENDING_S", 0.2)
    (tmp_path / "endless.py").write_text(f"{before}open({str(tmp_path / 'begun')!r}, 'w').close()\n")
    with (tmp_path / "endless.py").open("a") as file:
        file.write(f"{' ' * 4 * bool(before)}while True: pass\n")
    (tmp_path / "mended.py").write_text("def controller(robot):\n    robot.set_speed(5, 5)\n")
    session = SessionActions(Documents(tmp_path), inbox)

    def do(name: str, **values: object) -> None:
        action = session.actions[name]
        action.do(action.kind(**values))

    do("start", draft=draft_of(Playpen.load("default")))
    inbox.wait("twin")
    do("run", controllers=("endless.py",), cycles=1)
    while not (tmp_path / "begun").exists():
        time.sleep(0.01)
    assert inbox.wait("picture", lambda picture: picture["busy"])["robots"][0]["x_mm"] == pytest.approx(
        300, abs=1
    )
    hung = session._actor._thread  # type: ignore[union-attr]
    with pytest.raises(PortError, match="busy"):
        do("run", controllers=("mended.py",), cycles=5)
    do("stop")
    assert "left to itself" in inbox.wait("error")["text"]
    inbox.wait("ended")
    assert session.running_twin() is None
    do("start", draft=draft_of(Playpen.load("default")), speed=0.0)
    inbox.wait("twin")
    do("run", controllers=("mended.py",), cycles=5)
    assert inbox.wait("run")["cycles"] == 5
    session.close()
    # It executes Python, so it could be interrupted, and takes no time from later programs.
    hung.join(30)
    assert not hung.is_alive()
