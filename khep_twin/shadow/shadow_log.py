"""Log of a shadow: its updates as an MCAP file (`khep_twin.log.shadow_channels` has the channels).

    log = ShadowLog(Path("shadow.mcap"), playpen, settings, parent=Path("robot.mcap"))
    for update in shadow.feed(...):
        log.write(update)
    log.close()

Times are those of the bytes on the robot's serial line. The same updates give the same file.
"""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from khep_twin import playpen as playpens
from khep_twin.clock import NS_PER_S
from khep_twin.log import channels, shadow_channels
from khep_twin.log.channels import ArrayFrame, TextLine
from khep_twin.log.frames import MovingBodies
from khep_twin.log.log_file import FileRecorder, LogFile
from khep_twin.log.reader import hash_file
from khep_twin.log.recorder import FLUSH_NS
from khep_twin.log.run_description import versions
from khep_twin.log.shadow_channels import PARTICLES, PoseState, Suspicion, residual_names
from khep_twin.playpen import Playpen
from khep_twin.playpen_to_mjcf import to_spec
from khep_twin.robots.model import robot_name
from khep_twin.sensing import calibration
from khep_twin.shadow.following import LastingAlarms
from khep_twin.shadow.particles import LearnedValues, value_names
from khep_twin.shadow.shadow import ShadowSettings
from khep_twin.shadow.update import Update

ROBOT = robot_name(0)
"""Name of the robot in the log."""

LIVE_FLUSH_NS = NS_PER_S // 2
"""Time between two flushes beside a robot, for programs that follow the file [ns]."""

PARTICLES_NS = NS_PER_S
"""Time between two messages of particles [ns]."""

MIN_CHANGE = 0.05
"""Change of a suspected fault's probability from which a message is written."""


class ShadowLog(FileRecorder):
    """Log of a shadow.

    Args:
        path: Path of the finished log, by convention NAME.mcap.
        playpen: Playpen of the shadow.
        settings: Settings of the shadow.
        parent: Log that the shadow reads; None beside a robot.
        flush_ns: Time between two flushes to the file system [ns].

    Raises:
        LogError: The file cannot be made, or the parent cannot be read; in each method: it cannot be written.
    """

    def __init__(
        self,
        path: Path,
        playpen: Playpen,
        settings: ShadowSettings,
        *,
        parent: Path | None = None,
        flush_ns: int = FLUSH_NS,
    ) -> None:
        origin = {} if parent is None else {"parent": parent.name, "parent_sha256": hash_file(parent)}
        self._time_ns = self._flushed_ns = 0
        self._flush_ns = flush_ns
        self._particles_ns = -PARTICLES_NS
        self._alarms = LastingAlarms()
        self._state: PoseState | None = None
        self._suspected: dict[frozenset[str], float] = {}
        self._ghost = _Ghost(playpen)
        sensors = playpen.robots[0].body.ring_sensors
        residuals, values = residual_names(sensors), value_names(sensors)
        self._proximity = ArrayFrame(len(sensors), "f8", f"{', '.join(sensors)} [counts]")
        self._residuals = ArrayFrame(len(residuals), "f8", ", ".join(residuals))
        self._learned = ArrayFrame(len(values), "f8", ", ".join(values))
        self._particles = ArrayFrame(3 * PARTICLES, "f8", "x, y [m], heading [rad] of each particle")
        self._file = LogFile(path, lambda: self._time_ns)
        self._write_header(playpen, settings, origin)
        self._file.on_exit = self.close

    def write(self, update: Update) -> None:
        """Write an update; flush everything so far every `flush_ns`."""
        if not self._file.open:
            return
        time_ns = self._time_ns = update.time_ns
        estimate = update.estimate
        message = channels.pose_message(time_ns, estimate.pose, estimate.covariance)
        self._file.add("/shadow/pose", channels.POSE_WITH_COVARIANCE, time_ns, message)
        message = channels.pose_message(time_ns, update.reckoned)
        self._file.add("/shadow/reckoned", channels.POSE, time_ns, message)
        self._file.add("/tf", channels.TRANSFORMS, time_ns, self._ghost.message(time_ns, estimate.pose))
        self._add("expected", self._proximity, update.expected)
        self._add("measured", self._proximity, update.measured)
        self._add("residuals", self._residuals, np.hstack(update.residuals))
        if time_ns - self._particles_ns >= PARTICLES_NS:
            self._particles_ns = time_ns
            rows = np.linspace(0, len(update.particles) - 1, PARTICLES).round().astype(np.intp)
            self._add("particles", self._particles, update.particles[rows].ravel())
        if update.state is not self._state:
            self._state = update.state
            self._add_line("state", shadow_channels.state_line(time_ns, update.state))
        if self._update_suspected(update.suspected):
            self._add_line("suspected", shadow_channels.suspicion_line(time_ns, update.suspected))
        for change in self._alarms.changes(time_ns, update.alarms, update.ended):
            is_start = change.alarm.ended_ns is None
            make_line = shadow_channels.alarm_start_line if is_start else shadow_channels.alarm_end_line
            self._add_line("alarms", make_line(change.time_ns, change.alarm))
        if time_ns - self._flushed_ns >= self._flush_ns:
            self._flushed_ns = time_ns
            self._file.flush()

    def write_learned(self, values: LearnedValues) -> None:
        """Write the learned values of the robot, at the time of the last update."""
        if self._file.open:
            self._add("learned", self._learned, values.row)

    def flush(self) -> None:
        """Flush everything so far to the file system."""
        if self._file.open:
            self._file.flush()

    def close(self) -> None:
        """Complete the file and rename it to its path."""
        if self._file.open:
            self._file.finish()

    def _add(self, name: str, frame: ArrayFrame, values: NDArray[np.float64]) -> None:
        message = frame.messages(values[None])[0].tobytes()
        self._file.add(f"/shadow/{name}", channels.FLOATS, self._time_ns, message)

    def _add_line(self, name: str, line: TextLine) -> None:
        self._file.add(f"/shadow/{name}", channels.LINES, line.time_ns, channels.line_message(line))

    def _update_suspected(self, suspected: Sequence[Suspicion]) -> bool:
        """Store suspected faults that differ by `MIN_CHANGE` from the stored ones; return whether they do."""
        current = {frozenset(suspicion.faults): suspicion.probability for suspicion in suspected}
        last = self._suspected
        if current.keys() == last.keys() and all(abs(current[key] - last[key]) < MIN_CHANGE for key in last):
            return False
        self._suspected = current
        return True

    def _write_header(self, playpen: Playpen, settings: ShadowSettings, parent: Mapping[str, str]) -> None:
        attachments = {
            "playpen.toml": playpens.dump(playpen),
            "scene.xml": self._ghost.scene,
            "configuration.json": json.dumps(asdict(settings), indent=2, sort_keys=True, default=str) + "\n",
            f"calibration/{ROBOT}.toml": calibration.read(playpen.robots[0].calibration)[1],
        }
        metadata = {"playpen": playpen.name, "robots": ROBOT, "shadow": "1", **versions(), **parent}
        self._file.describe(attachments, {**metadata, **asdict(settings)})
        self._file.add_scene(0, self._ghost.model)
        self._file.flush()


class _Ghost:
    """Robot of a compiled model that is drawn at the estimated poses."""

    def __init__(self, playpen: Playpen) -> None:
        spec = to_spec(playpen)
        self.model = spec.compile()
        self.scene = spec.to_xml()
        self._data = mujoco.MjData(self.model)
        self._qpos_index = int(self.model.joint(f"{ROBOT}/pose").qposadr[0])
        self._bodies = MovingBodies(self.model)

    def message(self, time_ns: int, pose: tuple[float, float, float]) -> bytes:
        """Return a message of /tf with the robot at a pose."""
        model, data = self.model, self._data
        x, y, heading = pose
        qpos = data.qpos[self._qpos_index :]
        qpos[:2] = x, y
        qpos[3:7] = np.cos(heading / 2), 0, 0, np.sin(heading / 2)
        mujoco.mj_kinematics(model, data)
        return self._bodies.messages(np.array([time_ns]), data.xpos[None], data.xquat[None]).tobytes()
