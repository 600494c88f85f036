"""Sessions of the page: twins that are watched, moved, switched, shared and repeated; robots at ports."""

import asyncio
import json
import math
import os
import signal
import tempfile
import threading
import time
import warnings
from collections.abc import Iterator, Mapping
from itertools import pairwise
from pathlib import Path
from statistics import median
from types import SimpleNamespace
from typing import Any, ClassVar

import pytest
from starlette.websockets import WebSocketDisconnect

from khep_twin.errors import KhepTwinError, PortError
from khep_twin.host import Khepera, Khepera4, connection
from khep_twin.lab.experiment.controllers import braitenberg
from khep_twin.lab.experiment.repeat import repeat
from khep_twin.lab.experiment.series_run import Plan
from khep_twin.lab.sensor_test.sensor_test import SensorRun, SensorTest
from khep_twin.log.recorded import read_recorded_run
from khep_twin.playpen import Playpen
from khep_twin.ports.host_port import NOTHING, HostPort, Received
from khep_twin.ports.twin import TwinOptions, open_twin
from khep_twin.web.broadcaster import Broadcaster
from khep_twin.web.documents import Documents
from khep_twin.web.drafts import draft_of
from khep_twin.web.jobs import SeriesJob, sensor_job
from khep_twin.web.paced_twin import OutsideHost
from khep_twin.web.requests import Request, RequestError, RunRequest, StartRequest
from khep_twin.web.robot_session import RobotActor
from khep_twin.web.session_actions import SessionActions
from khep_twin.web.twin_session import TwinActor
from tests.web.conftest import Inbox


@pytest.fixture
def actor(inbox: Inbox, tmp_path: Path) -> Iterator[TwinActor]:
    """A recorded twin among two lamps, as fast as possible."""
    actor = TwinActor(Playpen.load("two-lamps"), TwinOptions(seed=3), tmp_path / "run.mcap", inbox)
    actor.set_pace(math.inf, False)
    actor.begin()
    yield actor
    actor.end()
    assert not actor.is_alive


def test_a_twin_is_driven_lifted_and_switched_and_its_log_repeats(
    actor: TwinActor, inbox: Inbox, tmp_path: Path
) -> None:
    inbox.wait("twin")
    actor.start_jobs(SeriesJob("braitenberg", braitenberg, Plan(runs=2, cycles=100), None))
    inbox.wait("run")
    actor.put_robot(0, 100, 120, 45)
    actor.switch_lamp(0, False)
    assert (
        inbox.wait("picture", lambda message: message["lamps"][0]["power_w"] == 0)["lamps"][1]["power_w"] > 0
    )
    assert inbox.wait("run")["number"] == 2
    inbox.wait("done")
    actor.switch_lamp(0, True)
    inbox.wait("picture", lambda message: message["lamps"][0]["power_w"] > 0)
    actor.end()
    recorded = read_recorded_run(tmp_path / "run.mcap")
    assert repeat(recorded) is None


def test_a_khepera4_is_shown_beside_a_khepera_with_all_its_sensors(inbox: Inbox) -> None:
    actor = TwinActor(Playpen.load("arena4-two"), TwinOptions(), None, inbox)
    actor.begin()
    large, _, small = inbox.wait("twin")["robots"]
    assert [len(large[key]) for key in ("sensors", "names", "sonar", "leds_mm")] == [8, 12, 5, 3]
    assert (large["radius_mm"], small["radius_mm"], small["sonar"]) == (70.4, 27.5, [])
    large, _, small = inbox.wait("picture", lambda message: message["time"] > 0.1)["robots"]
    assert [len(large[key]) for key in ("proximity", "ambient", "speed", "leds")] == [12, 12, 2, 9]
    assert (len(large["more"]["ultrasonic"]), small["more"]) == (5, {})
    actor.end()


def test_there_is_no_room_for_a_robot_in_a_wall(actor: TwinActor, inbox: Inbox) -> None:
    inbox.wait("twin")
    actor.put_robot(0, 5, 5, 0)
    assert "overlaps the left wall" in inbox.wait("refused")["text"]
    actor.switch_lamp(7, False, "a-page")
    refusal = inbox.wait("refused")
    assert "lamp = 7" in refusal["text"]
    assert refusal["tab"] == "a-page"


def test_a_held_robot_is_reported_to_have_room_or_not(actor: TwinActor, inbox: Inbox) -> None:
    inbox.wait("twin")
    actor.report_room(0, 5, 5)
    assert "overlaps the left wall" in inbox.wait("room")["reason"]
    actor.report_room(0, 100, 120)
    inbox.wait("room", lambda message: message["reason"] == "")
    actor.report_room(7, 100, 120, "a-page")
    assert inbox.wait("refused")["tab"] == "a-page"


def test_a_paused_twin_steps_by_a_tenth_of_a_second(actor: TwinActor, inbox: Inbox) -> None:
    inbox.wait("picture")
    actor.set_pace(1.0, True)
    before = inbox.wait("picture", lambda message: message["paused"])["time"]
    actor.step()
    after = inbox.wait("picture", lambda message: message["time"] > before + 0.09)
    assert after["time"] == pytest.approx(before + 0.1, abs=0.011)


def test_one_job_at_a_time(actor: TwinActor, inbox: Inbox) -> None:
    inbox.wait("twin")
    long = SeriesJob("braitenberg", braitenberg, Plan(cycles=10**6), None)
    actor.start_jobs(long)
    with pytest.raises(PortError, match="busy"):
        actor.start_jobs(long)
    inbox.wait("picture", lambda message: message["part"] > 0)
    actor.stop_jobs()
    row = inbox.wait("run")
    assert (row["stopped"], row["cycles"] > 0, row["metrics"]["distance_m"] > 0) == (True, True, True)
    inbox.wait("done")
    inbox.wait("picture", lambda message: not message["busy"])


def test_a_controller_that_never_ends_its_cycle_is_broken_off_and_the_motors_stand(
    actor: TwinActor, inbox: Inbox
) -> None:
    def stubborn(robot: Khepera) -> None:
        while True:
            robot.set_speed(5, 5)

    inbox.wait("twin")
    actor.start_jobs(SeriesJob("stubborn", stubborn, Plan(cycles=5), None))
    inbox.wait("picture", lambda message: message["busy"] and message["robots"][0]["speed"] == [5, 5])
    actor.stop_jobs()
    row = inbox.wait("run")
    assert (row["number"], row["stopped"], row["cycles"], row["seconds"] > 0) == (1, True, 0, True)
    inbox.wait("done")
    assert inbox.wait("picture", lambda message: message["robots"][0]["speed"] == [0, 0])


def test_each_robot_has_a_controller_of_its_own_and_a_stop_ends_all(inbox: Inbox, tmp_path: Path) -> None:
    draft = draft_of(Playpen.load("default"))
    draft["robot"] = [{"x_mm": x_mm, "y_mm": 250, "heading_deg": 90} for x_mm in (150, 300, 450)]
    (tmp_path / "back.py").write_text(
        "def controller(robot):\n    print('back')\n    robot.set_speed(-3, -3)\n    robot.sleep(0.05)\n"
    )
    (tmp_path / "stubborn.py").write_text(
        "def controller(robot):\n    print('on')\n    while True:\n        robot.set_speed(5, 5)\n"
    )
    session = SessionActions(Documents(tmp_path), inbox)
    run = session.actions["run"]
    session.actions["start"].do(StartRequest(draft=draft, speed=0))
    inbox.wait("twin")
    names = ("back.py", "", "stubborn.py")
    with pytest.raises(RequestError, match="4 controllers; expected 1 to 3"):
        run.do(RunRequest(controllers=(*names, "back.py"), cycles=10**6))
    run.do(RunRequest(controllers=names, cycles=10**6, folder="kept"))
    message = inbox.wait("picture", lambda message: message["time"] > 0.5)
    assert [robot["speed"][0] for robot in message["robots"]] == pytest.approx([-3, 0, 5], abs=2)
    session.actions["stop"].do(Request())
    assert sorted(inbox.wait("run")["robot"] for _ in range(2)) == [0, 2]
    inbox.wait("done")
    inbox.wait("picture", lambda message: all(robot["speed"] == [0, 0] for robot in message["robots"]))
    run.do(RunRequest(controllers=("back.py", "", "back.py"), cycles=2, folder="kept"))
    inbox.wait("done")
    assert sorted(path.name for path in (tmp_path / "kept").iterdir()) == ["khepera0", "khepera2"]
    session.close()


def test_a_page_that_is_opened_has_the_last_picture_at_once() -> None:
    """The next one may take long, as a program may let no time pass."""
    broadcaster = Broadcaster()
    broadcaster.publish({"kind": "twin", "playpen": "default", "robots": [], "log": None})
    broadcaster.publish({"kind": "picture", "time": 2.5, "busy": True, "part": 0, "robots": []})

    class Socket:
        sent: ClassVar[list[Any]] = []

        async def accept(self) -> None: ...

        async def send_text(self, text: str) -> None:
            self.sent.append(json.loads(text))

        async def receive_text(self) -> str:
            while len(self.sent) < 3:
                await asyncio.sleep(0)
            raise WebSocketDisconnect

    asyncio.run(broadcaster.serve(Socket()))  # type: ignore[arg-type]
    assert [(message["kind"], message.get("time")) for message in Socket.sent] == [
        ("twin", None),
        ("paths", None),
        ("picture", 2.5),
    ]


def test_an_outside_host_has_the_line_alone(actor: TwinActor, inbox: Inbox) -> None:
    port = inbox.wait("twin")["robots"][0]["port"]
    actor.set_pace(1.0, False)
    host = Khepera(port)
    try:
        assert host.versions() == ("5.02", "5.01")
        host.set_speed(5, 5)
        inbox.wait(
            "picture",
            lambda message: message["robots"][0]["speed"] == [5, 5] and message["robots"][0]["host"],
        )
    finally:
        host.close()


def test_an_outside_host_shares_the_line_with_a_program_and_each_has_its_own_replies(
    actor: TwinActor, inbox: Inbox
) -> None:
    port = inbox.wait("twin")["robots"][0]["port"]
    strange: list[str] = []

    def program(robot: Khepera) -> None:
        reply = robot.ask("E")
        if not reply.startswith("e,"):
            strange.append(reply)
        robot.sleep(0.01)

    actor.set_pace(2.0, False)
    actor.start_jobs(SeriesJob("program", program, Plan(cycles=10**6), None))
    inbox.wait("picture", lambda message: message["busy"])
    host = Khepera(port)
    try:
        replies = [host.ask(request)[:2] for request in "HNOB" * 5]
    finally:
        host.port.close()
    actor.stop_jobs()
    inbox.wait("done")
    assert replies == ["h,", "n,", "o,", "b,"] * 5
    assert strange == []


def test_a_sensor_test_gathers_rows(actor: TwinActor, inbox: Inbox) -> None:
    gathered: list[SensorRun] = []
    inbox.wait("twin")
    actor.start_jobs(sensor_job(SensorTest(rotate_deg=30), gathered.append))
    assert inbox.wait("sensed")["warning"] == gathered[0].warning
    assert len(gathered[0].times) > 5


def test_a_folder_that_has_a_series_is_refused_in_the_page_s_words(
    actor: TwinActor, inbox: Inbox, tmp_path: Path
) -> None:
    inbox.wait("twin")
    series = SeriesJob("braitenberg", braitenberg, Plan(cycles=2), tmp_path / "series")
    actor.start_jobs(series)
    inbox.wait("done")
    actor.start_jobs(series)
    assert inbox.wait("error")["text"].endswith("has a series of 1 runs already")
    inbox.wait("done")


def test_a_sensor_test_reports_where_nothing_was_within_reach(actor: TwinActor, inbox: Inbox) -> None:
    inbox.wait("twin")
    for quantity, x_mm, warning in (
        ("proximity", 300, "no proximity count is above"),
        ("proximity", 40, ""),
        ("light", 300, ""),
    ):
        actor.put_robot(0, x_mm, 250, 180)
        actor.start_jobs(sensor_job(SensorTest(what=quantity, rotate_deg=30), lambda run: None))
        text = inbox.wait("sensed")["warning"]
        assert (warning in text) if warning else not text
        inbox.wait("done")


def test_what_a_controller_prints_is_reported_and_all_else_is_not(
    capsys: pytest.CaptureFixture[str], actor: TwinActor, inbox: Inbox
) -> None:
    def talks(robot: Khepera) -> None:
        print("from the controller", "x" * 50_000)
        robot.sleep(0.1)

    inbox.wait("twin")
    actor.start_jobs(SeriesJob("talks", talks, Plan(cycles=2), None))
    print("from elsewhere")
    text = inbox.wait("printed")["text"]
    inbox.wait("done")
    assert text.endswith("x\n")
    assert len(text) < 60_000
    assert capsys.readouterr().out == "from elsewhere\n"


def test_a_controller_that_fails_is_reported_and_the_twin_goes_on(actor: TwinActor, inbox: Inbox) -> None:
    def failing(robot: Khepera) -> None:
        raise KhepTwinError("out of ideas")

    inbox.wait("twin")
    actor.start_jobs(SeriesJob("failing", failing, Plan(cycles=5), None))
    assert "out of ideas" in inbox.wait("error")["text"]
    inbox.wait("done")
    inbox.wait("picture", lambda message: not message["busy"])


def test_a_robot_at_a_port_shows_its_readings_and_stops(actor: TwinActor, inbox: Inbox) -> None:
    """The port is that of another twin, which replies like a robot."""
    port = inbox.wait("twin")["robots"][0]["port"]
    actor.set_pace(1.0, False)
    robot_inbox = Inbox()
    robot = RobotActor(port, robot_inbox)
    robot.begin()
    robot_inbox.wait("robot")
    first = robot_inbox.wait("picture")
    assert len(first["robots"][0]["proximity"]) == 8
    assert 0 <= first["time"] < 60  # since the connection
    robot.start_jobs(SeriesJob("braitenberg", braitenberg, Plan(cycles=10**6), None))
    robot_inbox.wait("picture", lambda message: max(message["robots"][0]["speed"]) > 3)
    robot.stop_jobs()
    robot_inbox.wait("done")
    robot_inbox.wait("picture", lambda message: message["robots"][0]["speed"] == [0, 0])
    robot.end()
    assert not robot.is_alive


def test_the_page_has_the_line_images_of_a_twin_and_of_a_robot_at_a_port(inbox: Inbox) -> None:
    """The robot's port is that of the twin."""
    twin = TwinActor(Playpen.load("stripes"), TwinOptions(), None, inbox)
    twin.begin()
    port = inbox.wait("twin")["robots"][0]["port"]
    first = inbox.wait("picture", lambda message: message["time"] > 0.5)["robots"][0]["vision"]
    assert len(first) == 64
    assert max(first) - min(first) > 100  # stripes
    robot_inbox = Inbox()
    robot = RobotActor(port, robot_inbox)
    robot.begin()
    other = robot_inbox.wait("picture")["robots"][0]["vision"]
    assert max(abs(a - b) for a, b in zip(first, other, strict=True)) < 80  # it stands; the noise differs
    robot.end()
    twin.end()


def test_how_far_a_job_is_comes_with_the_pictures_and_wakes_nobody_between(
    actor: TwinActor, inbox: Inbox
) -> None:
    inbox.wait("twin")
    kinds: list[str] = []

    def publish(message: Mapping[str, Any]) -> None:
        kinds.append(message["kind"])
        inbox(message)

    actor.publish = publish
    actor.start_jobs(SeriesJob("braitenberg", braitenberg, Plan(cycles=300), None))
    assert 0 < inbox.wait("picture", lambda message: message["part"] > 0)["part"] <= 1
    inbox.wait("done")
    assert inbox.wait("picture")["part"] == 1
    assert sorted(kind for kind in kinds if kind != "picture") == ["done", "run"]


def test_no_picture_is_reported_without_an_open_page() -> None:
    broadcaster = Broadcaster()
    broadcaster.publish({"kind": "picture", "time": math.nan, "busy": False, "part": 0, "robots": []})
    with pytest.raises(ValueError, match="not JSON compliant"):
        broadcaster.publish({"kind": "note", "text": math.nan})


def test_pictures_come_at_most_25_times_a_second(actor: TwinActor, inbox: Inbox) -> None:
    inbox.wait("picture")
    times: list[float] = []

    def publish(message: Mapping[str, Any]) -> None:
        times.append(time.monotonic())
        inbox(message)

    actor.publish = publish
    inbox.messages.clear()
    for _ in range(21):
        inbox.wait("picture")
    # Times are taken at publication, as a waiting thread may be woken late. A late picture
    # makes one gap longer and the next one shorter.
    assert median(after - before for before, after in pairwise(times)) >= 0.04 * 0.99


def test_a_program_that_does_not_end_is_left_and_the_next_twin_comes_up_beside_it(
    inbox: Inbox, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("khep_twin.web.session._ENDING_S", 0.2)
    inside, resume = threading.Event(), threading.Event()

    def hangs(robot: Khepera) -> None:
        inside.set()
        resume.wait(60)

    first, second = (TwinActor(Playpen.load("default"), TwinOptions(), None, inbox) for _ in range(2))
    first.begin()
    inbox.wait("twin")
    first.start_jobs(SeriesJob("hangs", hangs, Plan(1, cycles=1), None))
    assert inside.wait(30)
    first.end()
    assert "left to itself" in inbox.wait("error")["text"]
    inbox.wait("ended")
    second.begin()
    inbox.wait("twin")
    resume.set()
    second.set_pace(2.0, False)
    inbox.wait("picture", lambda picture: picture["speed"] == 2)
    assert not first.is_alive
    first._thread.join(30)  # pyright: ignore[reportPrivateUsage]
    assert "ended" not in [message["kind"] for message in inbox.messages]
    second.end()
    inbox.wait("ended")


def test_a_fork_of_a_controller_ends_and_its_log_repeats(
    actor: TwinActor, inbox: Inbox, tmp_path: Path
) -> None:
    forked: list[int] = []

    def forks(robot: Khepera) -> None:
        robot.set_speed(2, 2)
        if not forked:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", DeprecationWarning)  # beside other threads, from 3.12 on
                forked.append(os.fork())

    inbox.wait("twin")
    actor.start_jobs(SeriesJob("forks", forks, Plan(cycles=1000), None))
    inbox.wait("done")
    actor.end()
    end, ended = time.monotonic() + 20, 0
    try:
        while not (ended := os.waitpid(forked[0], os.WNOHANG)[0]) and time.monotonic() < end:
            time.sleep(0.02)
    finally:
        if not ended:
            os.kill(forked[0], signal.SIGKILL)
            os.waitpid(forked[0], 0)
    assert repeat(read_recorded_run(tmp_path / "run.mcap")) is None
    assert ended


def test_a_khepera4_at_a_port_is_shown_as_one_and_runs_programs(inbox: Inbox) -> None:
    twin = TwinActor(Playpen.load("arena4"), TwinOptions(), None, inbox)
    twin.begin()
    port = inbox.wait("twin")["robots"][0]["port"]
    robot_inbox = Inbox()
    robot = RobotActor(port, robot_inbox)
    robot.begin()
    shape = robot_inbox.wait("robot")["robots"][0]
    assert (shape["radius_mm"], len(shape["names"])) == (70.4, 12)
    assert len(robot_inbox.wait("picture")["robots"][0]["proximity"]) == 12
    robot.start_jobs(SeriesJob("braitenberg", braitenberg, Plan(cycles=5), None))
    assert robot_inbox.wait("run")["cycles"] == 5
    robot.end()
    twin.end()


def test_a_khepera_and_a_khepera4_each_have_a_program_and_an_error_ends_only_its_own(
    inbox: Inbox, tmp_path: Path
) -> None:
    draft = draft_of(Playpen.load("default"))
    draft["arena"] = {"width_mm": 1200, "height_mm": 600}
    draft["robot"] = [
        {"model": model, "x_mm": x_mm, "y_mm": 300, "heading_deg": 0}
        for model, x_mm in (("khepera1", 200), ("khepera4", 800))
    ]
    (tmp_path / "small.py").write_text("def controller(robot):\n    robot.set_speed(5, 5)\n")
    (tmp_path / "large.py").write_text("def controller(robot):\n    robot.set_speed(0.1, 0.1)\n")
    (tmp_path / "wrong.py").write_text(
        "def controller(robot):\n    robot.set_speed(0.1, 0.1)\n    robot.turret\n"
    )
    session = SessionActions(Documents(tmp_path), inbox)
    session.actions["start"].do(StartRequest(draft=draft, speed=0))
    shapes = inbox.wait("twin")["robots"]
    assert [shape["title"] for shape in shapes] == ["Khepera", "Khepera IV"]
    run = session.actions["run"]
    run.do(RunRequest(controllers=("small.py", "large.py"), seconds=1))
    runs = {message["robot"]: message["metrics"] for message in (inbox.wait("run"), inbox.wait("run"))}
    assert [runs[robot]["distance_m"] for robot in (0, 1)] == pytest.approx([0.04, 0.1], rel=0.2)
    inbox.wait("done")
    run.do(RunRequest(controllers=("small.py", "wrong.py"), seconds=1))
    text = inbox.wait("error")["text"]
    assert text.endswith("wrong.py:3: AttributeError: 'Khepera4' object has no attribute 'turret'")
    assert inbox.wait("run")["robot"] == 0
    inbox.wait("done")
    inbox.wait("picture", lambda picture: not picture["busy"])
    session.close()


def test_a_sensor_test_reads_the_sensors_of_a_khepera4(inbox: Inbox) -> None:
    gathered: list[SensorRun] = []
    twin = TwinActor(Playpen.load("arena4"), TwinOptions(), None, inbox)
    twin.set_pace(math.inf, False)
    twin.begin()
    inbox.wait("twin")
    twin.start_jobs(sensor_job(SensorTest(rotate_deg=30), gathered.append))
    inbox.wait("sensed")
    assert gathered[0].dv.shape[1] == 14
    twin.end()


@pytest.mark.parametrize("request_line", ["A,0", "D,150,150"])
def test_stop_ends_the_vehicle_and_the_drive_of_a_khepera4(inbox: Inbox, request_line: str) -> None:
    twin = TwinActor(Playpen.load("arena4"), TwinOptions(), None, inbox)
    twin.set_pace(10.0, False)
    twin.begin()
    port = inbox.wait("twin")["robots"][0]["port"]
    host = Khepera4(port)
    try:
        host.ask(request_line)
        inbox.wait("picture", lambda message: message["robots"][0]["speed"][0] > 50)
        twin.stop_jobs()
        inbox.wait("picture", lambda message: message["robots"][0]["speed"] == [0, 0])
    finally:
        host.port.close()
        twin.end()


def test_a_twin_starts_without_a_folder_for_temporary_files(
    inbox: Inbox, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse() -> str:
        raise FileNotFoundError(2, "No usable temporary directory found in []")

    monkeypatch.delenv("XDG_RUNTIME_DIR", raising=False)
    monkeypatch.setattr(tempfile, "gettempdir", refuse)
    twin = TwinActor(Playpen.load("default"), TwinOptions(), None, inbox)
    twin.begin()
    inbox.wait("picture")
    twin.end()


@pytest.mark.parametrize(("reply", "model"), [("b,4.06,4.06", "khepera1"), ("b,6.10,6.00", "khepera2")])
def test_a_robot_with_another_bios_has_the_model_of_the_nearest(
    actor: TwinActor, inbox: Inbox, monkeypatch: pytest.MonkeyPatch, reply: str, model: str
) -> None:
    port = inbox.wait("twin")["robots"][0]["port"]
    monkeypatch.setattr(connection, "find_baud_rate", lambda *_: (9600, reply))
    robot = connection.connect(port)
    opened_model = robot.model
    robot.port.close()
    assert opened_model.name == model


@pytest.mark.parametrize(
    ("playpen", "unfinished_line"), [("default", b""), ("default", b"D,20,"), ("arena4", b"")]
)
def test_the_replies_to_a_stop_of_the_page_do_not_reach_a_host(playpen: str, unfinished_line: bytes) -> None:
    class Port(HostPort):
        path, dropped, occupied = "port", 0, True
        sent = b""
        replies = b""

        def descriptors(self, has_room: bool) -> tuple[int, ...]:
            return ()

        def settings(self) -> None:
            return None

        def receive(self, limit: int, is_answered: bool = False) -> Received:
            sent, self.sent = self.sent, b""
            return Received(sent) if sent else NOTHING

        def write(self, data: bytes, is_end: bool = False) -> None:
            self.replies += data

    port = Port()
    with open_twin(playpen) as twin:
        host = OutsideHost(twin, twin.robots[0], port, pytest.fail)

        def exchange(sent: bytes) -> bytes:
            port.sent, port.replies = sent, b""
            end_ns = twin.world.time_ns + 500_000_000
            while twin.world.time_ns < end_ns:
                host.exchange(None)
                twin.world.advance_to(min(host.next_ns(), end_ns, twin.world.time_ns + 1_000_000))
            return port.replies

        assert exchange(b"D,5,5\n" + unfinished_line) == b"d\r\n"
        assert max(twin.robots[0].readings()["speed"]) > 0
        host.stop_motors()
        assert exchange(b"") == b""
        assert set(twin.robots[0].readings()["speed"]) == {0}
        assert exchange(b"B\n").startswith(b"b,")


def test_a_long_line_of_a_host_beside_a_program_has_a_reply(actor: TwinActor, inbox: Inbox) -> None:
    port = inbox.wait("twin")["robots"][0]["port"]
    actor.start_jobs(SeriesJob("waits", lambda robot: robot.sleep(0.1), Plan(cycles=10**6), None))
    inbox.wait("picture", lambda message: message["busy"])
    host = Khepera(port, timeout=60)
    try:
        assert host.ask("D" * 1500).startswith("Command not found")
        assert host.ask("B").startswith("b,")
    finally:
        host.port.close()
    actor.stop_jobs()


def test_a_page_that_is_opened_has_the_paths_of_the_robots_so_far() -> None:
    broadcaster = Broadcaster()
    broadcaster.publish({"kind": "twin", "playpen": "default", "robots": [], "log": None})
    readings = {"proximity": [], "ambient": [], "speed": [], "leds": []}
    for x_mm in (0.0, 2.0, 10.0, 20.0):
        robot = {**readings, "x_mm": x_mm, "y_mm": 0.0}
        broadcaster.publish({"kind": "picture", "time": 1, "busy": False, "part": 0, "robots": [robot]})  # pyright: ignore
    assert broadcaster._paths == [[(0, 0), (10, 0), (20, 0)]]  # pyright: ignore[reportPrivateUsage]


def test_while_a_program_runs_the_robot_is_polled_at_an_interval() -> None:
    polls_s: list[float] = []

    def read() -> dict[str, list[int]]:
        polls_s.append(robot.time)
        return {"proximity": [], "ambient": [], "speed": []}

    robot = SimpleNamespace(time=1000.0, read_panel=read)
    actor = RobotActor("", lambda _: None)
    for part in range(40):
        robot.time += 0.05
        actor._set_progress(part / 40, robot)
    assert [round(after - before, 3) for before, after in pairwise(polls_s)] == [0.2] * 9
