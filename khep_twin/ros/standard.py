"""Standard messages of ROS 2 from a robot's channels, for any model by its contract.

    odom            nav_msgs/Odometry           by the wheels' counters, header khepera0/odom
    joint_states    sensor_msgs/JointState      angles of the wheels
    ps0 ...         sensor_msgs/Range           infrared sensors around the robot
    gs0 ...         sensor_msgs/Range           sensors of the ground: minus infinity over a light floor
    us0 ...         sensor_msgs/Range           ultrasonic sensors
    scan            sensor_msgs/LaserScan       both rings, from the robot's centre
    ls0 ...         sensor_msgs/Illuminance     ambient light, in lux of an incandescent lamp
    imu             sensor_msgs/Imu             accelerometer and gyroscope
    battery_state   sensor_msgs/BatteryState
    vision/image_raw  sensor_msgs/Image         line camera
    /tf             tf2_msgs/TFMessage          odom > base_link

A channel that is not given has no messages. A sample at time 0 only starts the odometry: in ROS, a clock at 0
has not started, and a transform of time 0 is the latest one.
"""

import math
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from khep_twin.log.cdr import Frame
from khep_twin.log.channels import BASE_FRAME, IMAGE, PLANAR_ROWS, TRANSFORMS, TransformFrame
from khep_twin.log.message_types import Message, MessageFields
from khep_twin.log.transforms import from_planar
from khep_twin.robots.model import RobotModel
from khep_twin.ros.distances import Beam, Floats, GroundLaw, InfraredLaw, SonarLaw
from khep_twin.ros.odometry import Odometry, Track
from khep_twin.ros.quantities import columns_of
from khep_twin.ros.scan import SCAN, scan_frame, scan_ranges
from khep_twin.sensing.calibration import Calibration

ODOMETRY = "nav_msgs/msg/Odometry"
JOINTS = "sensor_msgs/msg/JointState"
RANGE = "sensor_msgs/msg/Range"
ILLUMINANCE = "sensor_msgs/msg/Illuminance"
IMU = "sensor_msgs/msg/Imu"
BATTERY = "sensor_msgs/msg/BatteryState"
CLOCK = "rosgraph_msgs/msg/Clock"

SUPPLY_VOLTAGE = "supply_voltage"
"""Channel of the voltage of the supply [V], which nodes read and logs lack."""

ODOM_FRAME = "{}/odom"
"""Frame of a robot's odometry by the robot's name, as REP 105 names it."""

_INFRARED, _ULTRASOUND = 1, 0
_LUMENS_PER_WATT = 10.0
"""Luminous efficacy of a small incandescent lamp, by which counts of light become lux [lm/W] (assumed)."""

_PLANAR_VARIANCE = 1e-6
"""Variance of what a robot on a floor cannot do: a rise, roll or pitch (assumed)."""

_OPTICAL = (-0.5, 0.5, -0.5, 0.5)
"""Rotation x, y, z, w of a camera's frame that looks forward: z forward, x right (REP 103)."""

_STEPS_PER_UNIT = 2.0**24
"""Resolution of positions [1/m], speeds and quaternions [1]: 0.06 um. Finer digits do not compress."""

Times = NDArray[np.int64]
FixedFrame = tuple[str, str, tuple[float, ...]]
"""Fixed frame: parent, name, and pose x, y, z [m] and quaternion x, y, z, w."""


class StandardRows(NamedTuple):
    """Messages of one topic.

    Attributes:
        topic: Topic, e.g. "/khepera0/odom".
        type_name: Type, e.g. "nav_msgs/msg/Odometry".
        times_ns: Times of the messages (n,) [ns], some of those of the samples.
        messages: Messages, as rows of bytes (n,).
    """

    topic: str
    type_name: str
    times_ns: Times
    messages: NDArray[np.void]


class StandardMessages:
    """Standard messages of one robot; its odometry continues over calls.

    Args:
        model: Model.
        calibration: Calibration.
        name: Name of the robot, e.g. "khepera0", the namespace of its topics and frames.

    Attributes:
        odometry: Odometry of the robot.
    """

    def __init__(self, model: RobotModel, calibration: Calibration, name: str) -> None:
        self._model, self._name, self._measured = model, name, calibration
        self._base, self._odom = BASE_FRAME.format(name), ODOM_FRAME.format(name)
        self.odometry = Odometry(model.body, calibration)
        self._infrared = InfraredLaw(model, calibration)
        self._ground = GroundLaw(model, calibration)
        self._sonar = SonarLaw(model)
        self._ranges = {beam.name: _range_frame(name, beam) for beam in self.beams}
        light = calibration.ambient
        # A lamp of P watts at a distance r gives gain P / r^2 counts and efficacy P / (4 pi r^2) lux.
        self._lux = _LUMENS_PER_WATT / (4 * math.pi) * 1e6 / np.array(light.gain_counts_mm2_per_w)
        variances = np.square(light.noise_counts * self._lux)
        self._lights = [
            Frame(
                ILLUMINANCE,
                {"header": {"frame_id": f"{name}/{beam.name}"}, "variance": variance},
                ["header.stamp", "illuminance"],
            )
            for beam, variance in zip(self._infrared.beams, variances.tolist(), strict=True)
        ]
        self._odometry_frame = Frame(
            ODOMETRY,
            {"header": {"frame_id": self._odom}, "child_frame_id": self._base},
            ["header.stamp", "pose.pose", "pose.covariance", "twist.twist", "twist.covariance"],
        )
        self._transforms = TransformFrame([(self._odom, self._base)])
        joints = {"name": [f"{name}/{side}_wheel_joint" for side in ("left", "right")]}
        joints |= {"position": np.zeros(2), "velocity": np.zeros(2)}
        self._joints = Frame(JOINTS, {**self._header(), **joints}, ["header.stamp", "position", "velocity"])
        self._scan = scan_frame(self._base, self.beams)

    @property
    def beams(self) -> list[Beam]:
        """Beams of all sensors of distances."""
        return [*self._infrared.beams, *self._ground.beams, *self._sonar.beams]

    def static_transforms(self) -> list[FixedFrame]:
        """Return the sensors' frames."""
        transforms: list[FixedFrame] = [
            (self._base, f"{self._name}/{beam.name}", (*beam.position, *beam.quaternion))
            for beam in self.beams
        ]
        if "vision" in self._model.channels:
            pose = (0.0, 0.0, self._model.body.height, *_OPTICAL)
            transforms.append((self._base, f"{self._name}/vision", pose))
        return transforms

    def messages(
        self, times_ns: Times, channels: Mapping[str, NDArray[np.generic]]
    ) -> Iterator[StandardRows]:
        """Yield the messages for samples at one or more times, later than those of the previous call.

        Args:
            times_ns: Times of the samples (n,) [ns].
            channels: Values of channels by the channel's name (n, width), as in a log.
        """
        is_late = times_ns > 0
        late_ns = times_ns[is_late]
        counts = self._wheel_counts(channels)
        if counts is not None and len(times_ns):
            track = self.odometry.advance(times_ns, counts)
            yield from self._motion(late_ns, Track(*(part[is_late] for part in track)))
        late = {name: values[is_late] for name, values in channels.items()}
        yield from self._distances(late_ns, late)
        yield from self._light(late_ns, late)
        yield from self._states(late_ns, late)

    def _wheel_counts(self, channels: Mapping[str, NDArray[np.generic]]) -> Floats | None:
        """Return the counts of the left and right wheel (n, 2); None if no channel has them."""
        interface = self._model.interface
        if "position" in channels:
            return channels["position"][:, :2].astype(np.float64)
        if "registers" in channels and interface is not None:
            return channels["registers"][:, list(interface.positions)].astype(np.float64)
        return None

    def _motion(self, times_ns: Times, track: Track) -> Iterator[StandardRows]:
        """Yield odometry, its transform, and angles of the wheels."""
        n = len(times_ns)
        pose = round_steps(from_planar(track.poses))
        twist = np.zeros((n, 6))
        twist[:, [0, 5]] = track.speeds
        pose_covariance = np.tile(_PLANAR_VARIANCE * np.eye(6), (n, 1, 1))
        twist_covariance = pose_covariance.copy()
        pose_covariance[:, np.array(PLANAR_ROWS)[:, None], PLANAR_ROWS] = track.pose_covariances
        twist_covariance[:, [0, 5], [0, 5]] = track.speed_variances
        values = {
            "header.stamp": times_ns,
            "pose.pose": pose,
            "pose.covariance": _shorten(pose_covariance),
            "twist.twist": round_steps(twist),
            "twist.covariance": _shorten(twist_covariance),
        }
        yield self._rows("odom", ODOMETRY, times_ns, self._odometry_frame, values)
        angles, rates = round_steps(track.angles), round_steps(track.rates)
        joints = {"header.stamp": times_ns, "position": angles, "velocity": rates}
        yield self._rows("joint_states", JOINTS, times_ns, self._joints, joints)
        transforms = self._transforms.messages(times_ns, pose[:, None])
        yield StandardRows("/tf", TRANSFORMS, times_ns, transforms)

    def _distances(
        self, times_ns: Times, channels: Mapping[str, NDArray[np.generic]]
    ) -> Iterator[StandardRows]:
        """Yield distances of sensors, and the scan."""
        parts: list[Floats] = []
        n_ring = len(self._infrared.beams)
        if (proximity := channels.get("proximity")) is not None:
            counts = proximity.astype(np.float64)
            parts.append(self._infrared.distances(counts[:, :n_ring]))
            parts.append(self._ground.distances(counts[:, n_ring:]))
        if (readings := channels.get("ultrasonic")) is not None:
            parts.append(self._sonar.distances(readings.astype(np.float64)))
        beams = self.beams if proximity is not None else self._sonar.beams
        if not parts or not beams:
            return
        distances = np.hstack(parts)
        for beam, column in zip(beams, distances.T, strict=False):
            is_valid = ~np.isnan(column)
            values = {"header.stamp": times_ns[is_valid], "range": column[is_valid]}
            yield self._rows(beam.name, RANGE, times_ns[is_valid], self._ranges[beam.name], values)
        values = {"header.stamp": times_ns, "ranges": scan_ranges(beams, distances)}
        yield self._rows("scan", SCAN, times_ns, self._scan, values)

    def _light(self, times_ns: Times, channels: Mapping[str, NDArray[np.generic]]) -> Iterator[StandardRows]:
        """Yield the illuminance at the sensors around the robot."""
        if (ambient := channels.get("ambient")) is None:
            return
        law = self._measured.ambient
        counts = ambient[:, : len(self._infrared.beams)].astype(np.float64)
        if law.rises_with_light:
            counts = self._measured.largest_count - counts
        columns = (np.maximum(law.dark_counts - counts, 0) * self._lux).T
        for k, (frame, column) in enumerate(zip(self._lights, columns, strict=True)):
            values = {"header.stamp": times_ns, "illuminance": column}
            yield self._rows(f"ls{k}", ILLUMINANCE, times_ns, frame, values)

    def _states(self, times_ns: Times, channels: Mapping[str, NDArray[np.generic]]) -> Iterator[StandardRows]:
        """Yield acceleration and rate of turn, battery and image."""
        force = columns_of(self._model, "accelerometer", channels)
        rate = columns_of(self._model, "gyroscope", channels)
        if len(force) == 3 or len(rate) == 3:
            message: MessageFields = {**self._header(), "orientation": {"w": 1}}
            message["orientation_covariance"] = [-1, *np.zeros(8)]
            values: MessageFields = {"header.stamp": times_ns}
            for field, axes, signs in (
                ("linear_acceleration", force, self._model.accelerometer_signs),
                ("angular_velocity", rate, (1, 1, 1)),
            ):
                if len(axes) == 3:
                    values[field] = np.column_stack([axes[axis] for axis in "xyz"]) * signs
                else:
                    message[f"{field}_covariance"] = [-1, *np.zeros(8)]
            yield self._rows("imu", IMU, times_ns, Frame(IMU, message, [*values]), values)
        battery = columns_of(self._model, "battery", channels)
        if (supply := channels.get(SUPPLY_VOLTAGE)) is not None:
            battery = {"voltage": supply[:, 0].astype(np.float64)}
        if battery:
            fields = "voltage", "current", "charge", "temperature"
            values = {"header.stamp": times_ns, **{name: battery[name] for name in fields if name in battery}}
            unknown = dict.fromkeys((*fields, "capacity", "design_capacity", "percentage"), math.nan)
            frame = Frame(BATTERY, {**self._header(), **unknown, "present": True}, [*values])
            yield self._rows("battery_state", BATTERY, times_ns, frame, values)
        if (greys := channels.get("vision")) is not None:
            width = greys.shape[1]
            header = {"header": {"frame_id": f"{self._name}/vision"}}
            size = {"height": 1, "width": width, "encoding": "mono8", "step": width, "data": bytes(width)}
            frame = Frame(IMAGE, {**header, **size}, ["header.stamp", "data"])
            values = {"header.stamp": times_ns, "data": greys}
            yield self._rows("vision/image_raw", IMAGE, times_ns, frame, values)

    def _rows(
        self, topic: str, type_name: str, times_ns: Times, frame: Frame, values: Message
    ) -> StandardRows:
        return StandardRows(f"/{self._name}/{topic}", type_name, times_ns, frame.messages(values))

    def _header(self) -> MessageFields:
        return {"header": {"frame_id": self._base}}


def transform_fields(frame: FixedFrame) -> MessageFields:
    """Return the fields of the transform of a fixed frame."""
    parent, name, (*position, qx, qy, qz, qw) = frame
    translation, rotation = dict(zip("xyz", position, strict=True)), {"x": qx, "y": qy, "z": qz, "w": qw}
    transform = {"translation": translation, "rotation": rotation}
    return {"header": {"frame_id": parent}, "child_frame_id": name, "transform": transform}


def _range_frame(name: str, beam: Beam) -> Frame:
    """Return the frame of a sensor's distances."""
    message = {
        "header": {"frame_id": f"{name}/{beam.name}"},
        "radiation_type": _INFRARED if beam.is_infrared else _ULTRASOUND,
        "field_of_view": beam.field_of_view,
        "min_range": beam.nearest,
        "max_range": beam.reach,
    }
    return Frame(RANGE, message, ["header.stamp", "range"])


def round_steps(values: Floats) -> Floats:
    """Return numbers in whole steps of the resolution."""
    return np.rint(values * _STEPS_PER_UNIT) / _STEPS_PER_UNIT


def _shorten(covariances: Floats) -> Floats:
    """Return matrices (n, 6, 6) as rows (n, 36) of numbers with 11 bits of precision, which compress.

    Larger variances make up for the rounding, so that a matrix stays positive definite.
    """
    mantissas, exponents = np.frexp(covariances * (1 + 2**-9 * np.eye(6)))
    return np.ldexp(np.rint(mantissas * 2**11) / 2**11, exponents).reshape(-1, 36)
