"""Sessions of the page: a twin in its playpen or a robot at a port, in a thread.

One thread owns the whole world of a twin; no other may touch it. The page's requests are passed to it, and
its pictures are passed to the page, at most 25 times a second.
"""

import math
import os
import threading
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack, closing, suppress
from dataclasses import replace
from pathlib import Path

from khep_twin.board.kernel import AMBIENT, PROXIMITY, SPEEDS, Board
from khep_twin.errors import KhepTwinError, PortError, ProtocolError
from khep_twin.host import Khepera, Vision, commands
from khep_twin.interventions.move_robot import as_it_stands, put
from khep_twin.interventions.switching import switch
from khep_twin.machine import n_forks
from khep_twin.playpen import Playpen
from khep_twin.playpen.starts import no_room
from khep_twin.ports.endpoints import open_any
from khep_twin.ports.event_sources import exact_timeouts
from khep_twin.ports.host_port import HostPort
from khep_twin.ports.protocol_khep import Serial
from khep_twin.ports.service_registry import registered
from khep_twin.ports.twin import TwinOptions, open_twin
from khep_twin.sensing import calibration
from khep_twin.units import BODIES
from khep_twin.web.jobs import Job, Publish
from khep_twin.web.outside_host import OutsideHost
from khep_twin.web.paced_twin import PacedTwin
from khep_twin.web.printed import taken_by
from khep_twin.web.scene import DrawnScene
from khep_twin.web.turret_outlines import TurretParts

_ENDING_S = 5.0
"""Longest time for a session to end: its controller has a second for its cycle [s]."""

_PRINT_LIMIT = 20_000
"""Longest output of a controller that is sent at once [characters]."""

_NOT_YET = "the twin is not there yet; expected a started twin"

_LOOK = 0.08
"""Interval at which the readings of a robot at a port are requested [s]."""


class WebSession:
    """Common part of twin and robot sessions: a thread with one job at a time.

    The thread calls `publish` with messages for the page. `job` is the current job, None without.
    """

    def __init__(self, publish: Publish) -> None:
        self._publish = publish
        self._left = False
        self.job: Job | None = None
        # The completed part of the job goes with the pictures, as jobs report it at each cycle.
        self._part = 0.0
        self._printed = ""
        self._n_forks = n_forks()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name="stage", daemon=True)

    def begin(self) -> None:
        """Start the thread."""
        self._thread.start()

    @property
    def alive(self) -> bool:
        """True if its thread is still running."""
        return self._thread.is_alive()

    def start(self, job: Job) -> None:
        """Start a job.

        Raises:
            PortError: The session has a job already, or has ended.
        """
        if self.job is not None or not self.alive:
            raise PortError("the robot is busy; expected a stopped robot" if self.alive else "it has ended")
        self._part = 0.0
        self.job = job

    def stop(self) -> None:
        """End the job and stop the motors."""
        raise NotImplementedError

    def end(self) -> None:
        """End the session; abandon a thread that does not end in time, and drop its messages."""
        self._ended.set()
        self._thread.join(_ENDING_S)
        if self.alive:
            self.publish({"kind": "error", "text": "the program does not end; it is left to itself"})
            self.publish({"kind": "ended"})
            self._left = True

    def publish(self, message: Mapping[str, object]) -> None:
        """Send a message to the page, unless this session was abandoned."""
        if not self._left:
            self._publish(message)

    def take_printed(self, text: str) -> None:
        """Keep a controller's output for `_tell_printed`; of long output, keep the end."""
        self._printed += text
        if len(self._printed) > 2 * _PRINT_LIMIT:
            self._printed = self._printed[-_PRINT_LIMIT:]

    def _tell_printed(self) -> None:
        text, self._printed = self._printed, ""
        if text:
            self.publish({"kind": "printed", "text": text})

    def _run(self) -> None:
        try:
            self._live()
        except KhepTwinError as error:
            self.publish({"kind": "error", "text": error.plain})
        except BaseException as error:  # reported in the page, then raised as usual
            self.publish({"kind": "error", "text": f"{type(error).__name__}: {error}"})
            raise
        finally:
            self.job = None
            self.publish({"kind": "ended"})

    def _live(self) -> None:
        raise NotImplementedError

    def _progress(self, part: float) -> None:
        self._leave_a_fork()
        self._part = round(part, 4)

    def _leave_a_fork(self) -> None:
        """End a process that a controller has forked: the session is the designer's alone."""
        if n_forks() != self._n_forks:
            os._exit(0)

    def _do(self, robot: Khepera, stop: Callable[[], bool]) -> None:
        """Do the job; report its errors and continue."""
        if (job := self.job) is None:
            return
        try:
            with taken_by(self.take_printed):
                job.do(robot, self.publish, self._progress, stop)
        except KhepTwinError as error:
            if not stop():
                self.publish({"kind": "error", "text": error.plain})
        finally:
            self._leave_a_fork()
            self.job = None
            self._tell_printed()
            self.publish({"kind": "done"})


class TwinActor(WebSession):
    """A twin in a playpen, with a pseudo-terminal for an outside host at each robot.

    Args:
        playpen: Playpen to simulate.
        options: Options of the twin.
        log: File of the log; None for none.
        publish: Function that takes messages for the page.
    """

    def __init__(self, playpen: Playpen, options: TwinOptions, log: Path | None, publish: Publish) -> None:
        super().__init__(publish)
        self.playpen, self._options, self._log = playpen, options, log
        self._paced: PacedTwin | None = None
        self._turrets: list[TurretParts] = []
        self._scene: DrawnScene | None = None
        self.speed, self.paused = 1.0, False

    @property
    def log(self) -> Path | None:
        """File of the log; None for none."""
        return self._log

    def set_pace(self, speed: float, paused: bool) -> None:
        """Set the speed of time, and whether it is paused."""
        self.speed, self.paused = speed, paused
        if self._paced is not None:
            self._paced.speed, self._paced.paused = speed, paused

    def step(self) -> None:
        """Advance one step."""
        if self._paced is not None:
            self._paced.step()

    def put(self, robot: int, x_mm: float, y_mm: float, heading_deg: float, page: str = "") -> None:
        """Move a robot for a page; report to it if there is no room."""
        self._request(lambda twin: put(twin.world, robot, x_mm, y_mm, heading_deg), page)

    def room(self, robot: int, x_mm: float, y_mm: float, page: str = "") -> None:
        """Report to a page why a held robot has no room at a position; with room, the reason is empty."""

        def report(twin: PacedTwin) -> None:
            reason = no_room(as_it_stands(twin.world), robot, x_mm, y_mm)
            self.publish({"kind": "room", "robot": robot, "reason": reason, "tab": page})

        self._request(report, page)

    def switch(self, lamp: int, on: bool, page: str = "") -> None:
        """Switch a lamp for a page."""
        self._request(lambda twin: switch(twin.world, lamp, on), page)

    def scene(self) -> DrawnScene:
        """Return the scene of the world, with the poses of its moving bodies in each picture's "bodies".

        Raises:
            PortError: The twin has not started yet.
        """
        if self._scene is None:
            raise PortError(_NOT_YET)
        return self._scene

    def stop(self) -> None:
        """End the job; without one, stop the motors."""
        if self.job is not None and self._paced is not None:
            self._paced.stop_program()
        else:
            self._request(lambda twin: twin.robot.send(b"D,0,0\n"))

    def end(self) -> None:
        """End the twin and complete its log."""
        if self._paced is not None:
            self._paced.ended = True
        super().end()

    def _request(self, action: Callable[[PacedTwin], None], page: str = "") -> None:
        """Have something done to the twin, for a page or for all."""
        twin = self._paced
        if twin is None:
            raise PortError(_NOT_YET)

        def safely() -> None:
            try:
                action(twin)
            except (KhepTwinError, IndexError) as error:
                text = error.plain if isinstance(error, KhepTwinError) else str(error)
                self.publish({"kind": "refused", "text": text, "tab": page})

        twin.request(safely)

    def _live(self) -> None:
        options = replace(self._options, robot=None)
        with ExitStack() as stack:
            twin = stack.enter_context(open_twin(self.playpen, options))
            bauds = [robot.firmware.baud for robot in twin.robots]
            ports = [stack.enter_context(closing(open_any(baud))) for baud in bauds]
            pairs = zip(twin.robots, ports, strict=True)
            hosts = [OutsideHost(twin, robot, port, self._note) for robot, port in pairs]
            if self._log is not None:
                twin.record(self._log)
            with suppress(PortError):
                what = f"twin in {self.playpen.name}, in a page"
                stack.enter_context(registered([port.path for port in ports], what))

            def show() -> None:
                self._tell_printed()
                self.publish(self._picture(paced, hosts))

            exact_timeouts()
            paced = PacedTwin(twin, hosts, show)
            stack.callback(paced.end)
            paced.speed, paced.paused = self.speed, self.paused
            self._turrets = [TurretParts(twin.world, index) for index in range(len(twin.robots))]
            self._scene = DrawnScene(twin.world.model, twin.world.data)
            self._paced = paced
            self.publish(self._cast(paced, ports))
            while not (paced.ended or self._ended.is_set()):
                if self.job is None:
                    paced.idle()
                    continue
                paced.busy = True
                paced.stop_program(False)
                try:
                    with Khepera(Serial.of(paced.view, timeout=1.0)) as robot:
                        self._do(robot, paced.stopping)
                finally:
                    paced.busy = False
                    paced.stop_program(False)

    def _cast(self, twin: PacedTwin, ports: Sequence[HostPort]) -> dict[str, object]:
        """Return the first message: the robots and the log."""
        return {
            "kind": "twin",
            "playpen": twin.world.playpen.name,
            "robots": [
                {
                    "name": robot.name,
                    "port": port.path,
                    "baud": robot.firmware.baud,
                    **shape(entry.model, entry.calibration),
                    "sensor_height_mm": BODIES[entry.model].sensor_height * 1e3,
                    "turrets": entry.turrets,
                }
                for robot, port, entry in zip(twin.robots, ports, twin.world.playpen.robots, strict=True)
            ],
            "log": None if self._log is None else self._log.name,
        }

    def _picture(self, twin: PacedTwin, hosts: list[OutsideHost]) -> dict[str, object]:
        """Return the present state of the world."""
        world = twin.world
        robots: list[dict[str, object]] = []
        now = as_it_stands(world)
        for index, (robot, host, entry) in enumerate(zip(twin.robots, hosts, now.robots, strict=True)):
            registers, image = robot.registers, robot.line_image
            robots.append(
                {
                    "x_mm": round(entry.x_mm, 2),
                    "y_mm": round(entry.y_mm, 2),
                    "heading_deg": round(entry.heading_deg, 2),
                    "proximity": registers[PROXIMITY].tolist(),
                    "ambient": registers[AMBIENT].tolist(),
                    "speed": registers[SPEEDS].tolist(),
                    "vision": None if image is None else image.tolist(),
                    "turrets": self._turrets[index].corners(),
                    "leds": registers[[Board.LED_0, Board.LED_1]].tolist(),
                    "host": host.port.occupied,
                    "host_commands": host.commands,
                }
            )
        lamps = [
            {"power_w": round(power, 3), "off": world.lamps.turned_off(index)}
            for index, power in enumerate(world.lamps.powers)
        ]
        return {
            "kind": "picture",
            "time": world.time_ns / 1e9,
            "busy": twin.busy,
            "paused": twin.paused,
            "speed": twin.speed if math.isfinite(twin.speed) else 0,
            "part": self._part,
            "robots": robots,
            "lamps": lamps,
            "bodies": [] if self._scene is None else self._scene.poses(),
            **{
                kind: {i: [it.x_mm, it.y_mm, it.angle_deg] for i, it in enumerate(items) if it.movable}
                for kind, items in now.objects.items()
            },
        }

    def _note(self, text: str) -> None:
        self.publish({"kind": "note", "text": text})


class RobotActor(WebSession):
    """Robot, or twin that is served elsewhere, at a port; its readings are polled."""

    def __init__(self, url: str, publish: Publish) -> None:
        super().__init__(publish)
        self._url = url
        self._halt = threading.Event()
        self._robot: Khepera | None = None
        self._vision: Vision | None = None
        self._began = self._looked = 0.0

    def stop(self) -> None:
        """End the job and stop the motors."""
        self._halt.set()

    def _live(self) -> None:
        with Khepera(self._url) as robot:
            self._robot, self._began = robot, robot.time
            with suppress(ProtocolError):  # a robot without this turret
                self._vision = Vision(robot)
            told = {"name": robot.name, "port": self._url, **shape("khepera1", "khepera1")}
            self.publish({"kind": "robot", "robots": [told]})
            while not self._ended.is_set():
                if self._halt.is_set():
                    robot.set_speed(0, 0)
                    self._halt.clear()
                self._look(robot)
                if self.job is not None:
                    self._do(robot, self._stopping)
                self._halt.wait(_LOOK)

    def _stopping(self) -> bool:
        return self._halt.is_set() or self._ended.is_set()

    def _progress(self, part: float) -> None:
        super()._progress(part)
        if self._robot is not None and self._robot.time - self._looked > 2 * _LOOK:
            self._look(self._robot)

    def _look(self, robot: Khepera) -> None:
        self._tell_printed()
        proximity, ambient, speed = robot.burst(commands.proximity(), commands.ambient(), commands.speed())
        self._looked = robot.time
        reading = {"proximity": [*proximity], "ambient": [*ambient], "speed": [*speed], "leds": [0, 0]}
        if self._vision is not None and self.job is None:  # a program's turns are not to wait for an image
            reading["vision"] = [*self._vision.image()]
        time_s, busy = robot.time - self._began, self.job is not None
        self.publish(
            {"kind": "picture", "time": time_s, "busy": busy, "part": self._part, "robots": [reading]}
        )


def shape(model: str, sensors: str) -> dict[str, object]:
    """Return a robot's radius and sensors, for drawing: [mm] and [deg]."""
    body = BODIES[model]
    poses = zip(body.sensor_positions, calibration.read(sensors)[0].heading_deg, strict=True)
    placed = [[round(x * 1e3, 2), round(y * 1e3, 2), heading] for (x, y), heading in poses]
    return {"radius_mm": body.radius * 1e3, "sensors": placed}
