"""Session of a twin in its playpen: its thread runs a `PacedTwin`, alone or in lock-step with programs."""

import math
from collections.abc import Callable, Sequence
from contextlib import ExitStack, closing, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from khep_twin.errors import KhepTwinError, PortError
from khep_twin.interventions.move_robot import current_playpen, place_robot
from khep_twin.interventions.switching import switch
from khep_twin.lab.experiment.multi_robot import drive_together
from khep_twin.playpen import Playpen
from khep_twin.playpen.starts import find_obstruction
from khep_twin.ports.endpoints import open_any_port
from khep_twin.ports.event_sources import set_exact_timeouts
from khep_twin.ports.host_port import HostPort
from khep_twin.ports.service_registry import registered_ports
from khep_twin.ports.twin import TwinOptions, open_twin
from khep_twin.web import messages
from khep_twin.web.messages import Publish
from khep_twin.web.paced_twin import OutsideHost, PacedTwin
from khep_twin.web.robot_shape import robot_shape
from khep_twin.web.scene import DrawnScene, TurretParts
from khep_twin.web.session import SessionActor

_NOT_STARTED = "the twin is not there yet; expected a started twin"


class TwinActor(SessionActor):
    """Twin in a playpen, with a pseudo-terminal for an outside host at each robot; `log` is its log file."""

    def __init__(self, playpen: Playpen, options: TwinOptions, log: Path | None, publish: Publish) -> None:
        super().__init__(publish)
        self.playpen = playpen
        self._options = options
        self.log = log
        self._twin: PacedTwin | None = None
        self._turrets: list[TurretParts] = []
        self._scene: DrawnScene | None = None
        self.speed = 1.0
        self.paused = False

    def set_pace(self, speed: float, paused: bool) -> None:
        """Set the speed of time, and whether it is paused."""
        self.speed, self.paused = speed, paused
        if self._twin is not None:
            self._twin.speed, self._twin.paused = speed, paused

    def step(self) -> None:
        """Advance one step."""
        if self._twin is not None:
            self._twin.step()

    def put_robot(self, robot: int, x_mm: float, y_mm: float, heading_deg: float, page: str = "") -> None:
        """Move a robot for a page; report to it if there is no room."""
        self._request(lambda twin: place_robot(twin.world, robot, x_mm, y_mm, heading_deg), page)

    def report_room(self, robot: int, x_mm: float, y_mm: float, page: str = "") -> None:
        """Report to a page why a held robot has no room at a position; the reason is empty if it has."""

        def report(twin: PacedTwin) -> None:
            reason = find_obstruction(current_playpen(twin.world), robot, x_mm, y_mm)
            self.publish({"kind": "room", "robot": robot, "reason": reason, "tab": page})

        self._request(report, page)

    def switch_lamp(self, lamp: int, on: bool, page: str = "") -> None:
        """Switch a lamp for a page."""
        self._request(lambda twin: switch(twin.world, lamp, on), page)

    def scene(self) -> DrawnScene:
        """Return the scene of the world; each picture's "bodies" has the poses of its moving bodies.

        Raises:
            PortError: The twin has not started yet.
        """
        if self._scene is None:
            raise PortError(_NOT_STARTED)
        return self._scene

    def end(self) -> None:
        """End the twin and complete its log."""
        if self._twin is not None:
            self._twin.is_ending = True
        super().end()

    def _halt_motors(self) -> None:
        if self.jobs and self._twin is not None:
            self._twin.stop_program()
        else:
            self._request(lambda twin: twin.stop_motors())

    def _request(self, action: Callable[[PacedTwin], object], page: str = "") -> None:
        """Have the twin's thread execute an action, for a page or for all."""
        twin = self._twin
        if twin is None:
            raise PortError(_NOT_STARTED)

        def run() -> None:
            try:
                action(twin)
            except (KhepTwinError, IndexError) as error:
                text = error.plain if isinstance(error, KhepTwinError) else str(error)
                self.publish({"kind": "refused", "text": text, "tab": page})

        twin.request(run)

    def _serve(self) -> None:
        with ExitStack() as stack:
            twin = stack.enter_context(open_twin(self.playpen, replace(self._options, robot=None)))
            ports = [
                stack.enter_context(closing(open_any_port(robot.firmware.baud))) for robot in twin.robots
            ]
            pairs = zip(twin.robots, ports, strict=True)
            hosts = [OutsideHost(twin, robot, port, self._publish_note) for robot, port in pairs]
            if self.log is not None:
                twin.record(self.log)
            with suppress(PortError):
                description = f"twin in {self.playpen.name}, in a page"
                stack.enter_context(registered_ports([port.path for port in ports], description))

            def publish_picture() -> None:
                self.output.flush()
                self.publish(self._picture(paced, hosts))

            set_exact_timeouts()
            paced = PacedTwin(twin, hosts, publish_picture)
            stack.callback(twin.close)
            paced.speed, paced.paused = self.speed, self.paused
            self._turrets = [TurretParts(twin.world, index) for index in range(len(twin.robots))]
            self._scene = DrawnScene(twin.world.model, twin.world.data)
            self._twin = paced
            self.publish(self._start_message(paced, ports))
            publish_picture()
            while not (paced.is_ending or self._is_ending()):
                if not self.jobs:
                    paced.idle()
                    continue
                publish_picture()  # a program may let no time pass
                jobs = {index: job for index, job in enumerate(self.jobs) if job is not None}
                paced.driven = [twin.robots[index] for index in jobs]
                do_job = partial(self._do_job, stop=paced.is_stopping)
                programs = {index: partial(do_job, job) for index, job in jobs.items()}
                try:
                    drive_together(paced.program_twin, programs)
                finally:
                    paced.driven = []
                    self._finish_jobs()
                    paced.stop_program(False)

    def _start_message(self, twin: PacedTwin, ports: Sequence[HostPort]) -> messages.TwinStarted:
        """Return the first message, with the robots and the log."""
        sites: NDArray[np.float64] = twin.world.model.site_pos
        return {
            "kind": "twin",
            "playpen": twin.world.playpen.name,
            "robots": [
                {
                    "name": robot.name,
                    "port": port.path,
                    **robot_shape(entry.robot_model, entry.calibration),
                    "sensor_height_mm": entry.body.sensor_height * 1e3,
                    "leds_mm": np.round(1e3 * sites[list(robot.indices.leds), :2], 2).tolist(),
                    "turrets": entry.turrets,
                }
                for robot, port, entry in zip(twin.robots, ports, twin.world.playpen.robots, strict=True)
            ],
            "log": None if self.log is None else self.log.name,
        }

    def _picture(self, twin: PacedTwin, hosts: list[OutsideHost]) -> messages.Picture:
        """Return the present state of the world."""
        world = twin.world
        robots: list[messages.RobotReadings] = []
        playpen = current_playpen(world)
        for index, (robot, host, entry) in enumerate(zip(twin.robots, hosts, playpen.robots, strict=True)):
            readings, image = robot.readings(), robot.line_image
            robots.append(
                {
                    "x_mm": round(entry.x_mm, 2),
                    "y_mm": round(entry.y_mm, 2),
                    "heading_deg": round(entry.heading_deg, 2),
                    "proximity": readings["proximity"],
                    "ambient": readings["ambient"],
                    "speed": readings["speed"][:2],
                    "vision": None if image is None else image.tolist(),
                    "turrets": self._turrets[index].corners(),
                    "leds": readings.get("leds", []),
                    "more": {name: readings[name] for name in messages.EXTRA_CHANNELS if name in readings},
                    "host": host.port.occupied,
                    "host_commands": host.commands,
                }
            )
        lamps = [
            {"power_w": round(power, 3), "off": world.lamps.is_switched_off(index)}
            for index, power in enumerate(world.lamps.powers)
        ]
        return {
            "kind": "picture",
            "time": world.time_ns / 1e9,
            "busy": bool(self.jobs),
            "paused": twin.paused,
            "speed": twin.speed if math.isfinite(twin.speed) else 0,
            "part": self._progress,
            "robots": robots,
            "lamps": lamps,
            "bodies": [] if self._scene is None else self._scene.poses(),
            "objects": {
                kind: {
                    i: [item.x_mm, item.y_mm, item.angle_deg] for i, item in enumerate(items) if item.movable
                }
                for kind, items in playpen.objects.items()
            },
        }

    def _publish_note(self, text: str) -> None:
        self.publish({"kind": "note", "text": text})
