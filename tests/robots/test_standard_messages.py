"""Standard messages of ROS 2 from channels, against closed forms and for each model."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scenes import arena, robot
from second_robot.model import SCOUT
from toy_robot.model import TOY

from khep_twin import playpen as playpens
from khep_twin.log.decoding import decode
from khep_twin.robots.model import RobotModel
from khep_twin.robots.registry import shipped_models
from khep_twin.ros.distances import InfraredLaw
from khep_twin.ros.standard import StandardMessages, StandardRows
from khep_twin.sensing.calibration import Calibration, read_for
from khep_twin.shadow.motion_noise import HEADING_NOISE, PLACE_NOISE
from khep_twin.world import World

STEP_NS = 20_000_000
MODELS = {**shipped_models(), "toy": TOY, "scout": SCOUT}


def calibration_of(model: RobotModel) -> Calibration:
    return read_for(model.calibration, model)


def standard(model: RobotModel) -> StandardMessages:
    return StandardMessages(model, calibration_of(model), "khepera0")


def times(n_samples: int, first: int = 1) -> NDArray[np.int64]:
    return STEP_NS * np.arange(first, first + n_samples)


def by_topic(rows: list[StandardRows]) -> dict[str, list[dict[str, Any]]]:
    """Return the decoded messages of each topic, whose name is without the namespace."""
    return {
        row.topic.removeprefix("/khepera0/"): [decode(row.type_name, m.tobytes()) for m in row.messages]
        for row in rows
    }


def read(model: RobotModel, **channels: list[list[float]]) -> dict[str, list[dict[str, Any]]]:
    arrays: Mapping[str, NDArray[Any]] = {name: np.array(values) for name, values in channels.items()}
    return by_topic([*standard(model).messages(times(len(next(iter(arrays.values())))), arrays)])


@pytest.mark.parametrize("name", MODELS)
def test_wheels_that_count_at_constant_rates_drive_a_circle(name: str) -> None:
    model = MODELS[name]
    wheels = calibration_of(model).wheels
    counts = np.arange(401)[:, None] * [3, 5]
    messages = by_topic([*standard(model).messages(times(401), {"position": counts})])
    left, right = (
        radius * math.tau / model.body.pulses_per_turn * n
        for radius, n in zip(wheels.radii, (3, 5), strict=True)
    )
    base = wheels.base_mm / 1000
    radius, turn = base / 2 * (right + left) / (right - left), (right - left) / base
    odom, joints, transform = (messages[topic][-1] for topic in ("odom", "joint_states", "/tf"))
    position, rotation = odom["pose"]["pose"]["position"], odom["pose"]["pose"]["orientation"]
    expected = (radius * math.sin(400 * turn), radius * (1 - math.cos(400 * turn)))
    assert (position["x"], position["y"]) == pytest.approx(expected, abs=1e-7)
    assert (rotation["z"], rotation["w"]) == pytest.approx(
        (math.sin(200 * turn), math.cos(200 * turn)), abs=1e-7
    )
    assert odom["twist"]["twist"]["linear"]["x"] == pytest.approx((left + right) / 2 / 0.02, abs=1e-7)
    assert odom["twist"]["twist"]["angular"]["z"] == pytest.approx(turn / 0.02, abs=1e-7)
    assert (odom["header"], odom["child_frame_id"]) == (
        {"stamp": 401 * STEP_NS, "frame_id": "khepera0/odom"},
        "khepera0/base_link",
    )
    (moved,) = transform["transforms"]
    assert moved["transform"] == {"translation": position, "rotation": rotation}
    assert joints["name"] == ["khepera0/left_wheel_joint", "khepera0/right_wheel_joint"]
    assert joints["position"] == pytest.approx(
        [n * 400 * math.tau / model.body.pulses_per_turn for n in (3, 5)]
    )


def test_single_samples_of_a_line_give_the_messages_of_a_log() -> None:
    model = MODELS["khepera2"]
    rng = np.random.default_rng(1)
    channels = {
        "position": np.cumsum(rng.integers(-3, 8, (50, 2)), axis=0),
        "proximity": rng.integers(0, 1021, (50, 8)),
    }
    together = [*standard(model).messages(times(50), channels)]
    messages, singles = standard(model), dict[str, list[bytes]]()
    for index, time_ns in enumerate(times(50)):
        sample = {name: values[index : index + 1] for name, values in channels.items()}
        for row in messages.messages(np.array([time_ns]), sample):
            singles.setdefault(row.topic, []).append(row.messages.tobytes())
    assert {row.topic: [m.tobytes() for m in row.messages] for row in together} == singles


def test_a_sample_at_time_0_only_starts_the_odometry() -> None:
    rows = [*standard(TOY).messages(times(3, first=0), {"position": np.array([[7, 7], [8, 8], [9, 9]])})]
    assert all(row.times_ns.tolist() == [STEP_NS, 2 * STEP_NS] for row in rows)
    steps = [message["pose"]["pose"]["position"]["x"] for message in by_topic(rows)["odom"]]
    assert steps == pytest.approx([TOY.body.pulse_length, 2 * TOY.body.pulse_length], abs=1e-7)


def test_a_counter_that_is_set_is_no_motion() -> None:
    messages = standard(MODELS["khepera1"])
    counts = np.array([[900, 900], [910, 910], [0, 0], [10, 10], [5000, 5000]])
    odom = by_topic([*messages.messages(times(5), {"position": counts})])["odom"]
    ways = [
        message["pose"]["pose"]["position"]["x"] / MODELS["khepera1"].body.pulse_length for message in odom
    ]
    assert ways == pytest.approx([0, 10, 10, 20, 20], abs=1e-3)


def test_the_covariance_of_a_straight_drive_is_that_of_a_random_heading() -> None:
    model, n = MODELS["khepera4"], 5000
    counts = np.arange(n + 1)[:, None] * [100, 100]
    odom, *_ = standard(model).messages(times(n + 1), {"position": counts})
    message = decode(odom.type_name, odom.messages[-1].tobytes())
    covariance = np.array(message["pose"]["covariance"]).reshape(6, 6)
    duration, length = n * 0.02, n * 100 * model.body.pulse_length
    assert covariance[0, 0] == pytest.approx(PLACE_NOISE**2 * duration, rel=0.02)
    assert covariance[5, 5] == pytest.approx(HEADING_NOISE**2 * duration, rel=5e-3)
    assert covariance[1, 1] == pytest.approx(HEADING_NOISE**2 * duration * length**2 / 3, rel=1e-2)
    assert covariance[1, 5] == pytest.approx(HEADING_NOISE**2 * duration * length / 2, rel=5e-3)
    assert np.linalg.eigvalsh(covariance).min() > 0
    assert np.linalg.eigvalsh(np.array(message["twist"]["covariance"]).reshape(6, 6)).min() > 0


def test_the_covariance_of_a_robot_that_stands_does_not_grow() -> None:
    odom = read(TOY, position=[[3, 3]] * 100)["odom"]
    assert odom[0]["pose"]["covariance"] == odom[-1]["pose"]["covariance"]


@pytest.mark.parametrize("name", MODELS)
def test_a_wide_white_wall_is_at_the_distance_of_the_calibrations_law(name: str) -> None:
    model = MODELS[name]
    law, rings = calibration_of(model).proximity, len(model.body.sensor_positions)
    beams = InfraredLaw(model, calibration_of(model)).beams
    # Near the end of its range, a sensor's step of one count is a few tenths of a millimetre.
    distances = np.array([0.7 * beam.nearest + 0.3 * beam.reach for beam in beams])
    gain, threshold, offset = (
        np.array(v) for v in (law.gain_counts_mm2, law.threshold_counts, law.offset_mm)
    )
    counts = gain / (1000 * distances + offset) ** 2 - threshold
    if law.saturates:
        counts /= (1 + (counts / law.limit_counts) ** 4) ** 0.25
    counts = np.rint(counts / law.quantum_counts) * law.quantum_counts
    reading = [*counts.tolist(), *[0] * len(model.body.ground_positions)]
    messages = read(model, proximity=[reading])
    for index in range(rings):
        (message,) = messages[f"ps{index}"]
        assert message["range"] == pytest.approx(distances[index], abs=6e-4)
        assert message["min_range"] < message["range"] < message["max_range"]
        assert (message["radiation_type"], message["header"]["frame_id"]) == (1, f"khepera0/ps{index}")
        assert 0.5 < message["field_of_view"] < math.pi


@pytest.mark.parametrize(("name", "gap_mm"), [("khepera1", 26), ("khepera2", 25), ("khepera3", 60)])
def test_a_twin_before_the_wall_of_an_arena_has_its_distance(name: str, gap_mm: float) -> None:
    model = MODELS[name]
    headings = calibration_of(model).heading_deg
    index = min(range(len(headings)), key=lambda k: abs(math.remainder(headings[k], 360)))
    (x, y), heading = model.body.sensor_positions[index], math.radians(headings[index])
    reach = x * math.cos(heading) + y * math.sin(heading)
    text = arena(1000, 800) + robot(1000 - gap_mm - 1000 * reach, 400, -headings[index], model=name)
    world = World(playpens.parse(text, "wall"), noise=False, compiled=False)
    world.advance(0.2)
    (message,) = read(model, proximity=[world.robots[0].readings()["proximity"]])[f"ps{index}"]
    assert message["range"] == pytest.approx(gap_mm / 1000, abs=2e-3)


@pytest.mark.parametrize("name", MODELS)
def test_saturation_is_too_near_and_darkness_is_nothing_in_range(name: str) -> None:
    model = MODELS[name]
    law, n = calibration_of(model).proximity, len(model.body.sensors)
    rest = [max(-threshold, 0) for threshold in law.threshold_counts]
    rest += [0] * (n - len(rest))
    messages = read(model, proximity=[[law.limit_counts] * n, rest])
    assert [message["range"] for message in messages["ps0"]] == [-math.inf, math.inf]
    near, empty = (np.array(message["ranges"]) for message in messages["scan"])
    assert {*near.tolist()} == {math.inf, -math.inf}
    assert np.isposinf(empty).all()


def test_ultrasonic_codes_follow_rep_117() -> None:
    khepera4 = read(MODELS["khepera4"], ultrasonic=[[0, 1000, 2000, 25, 250]])
    assert [message["range"] for k in (0, 1, 3, 4) for message in khepera4[f"us{k}"]] == [
        -math.inf,
        math.inf,
        0.25,
        2.5,
    ]
    assert khepera4["us2"] == []
    assert (khepera4["us3"][0]["min_range"], khepera4["us3"][0]["max_range"]) == (0.25, 2.5)
    assert read(MODELS["khepera3"], ultrasonic=[[0] * 5])["us0"][0]["range"] == math.inf
    scout = read(SCOUT, ultrasonic=[[0, 9999, 1500]])
    assert [scout[f"us{k}"][0]["range"] for k in range(3)] == [-math.inf, math.inf, 1.5]
    assert read(TOY, ultrasonic=[[0]])["us0"][0]["range"] == math.inf


def test_a_sensor_of_the_ground_sees_a_light_floor_or_none() -> None:
    first, second = (read(SCOUT, proximity=[[0, 0, 0, *counts]]) for counts in ((700, 20), (20, 700)))
    assert [m[f"gs{k}"][0]["range"] for m in (first, second) for k in (0, 1)] == [
        -math.inf,
        math.inf,
        math.inf,
        -math.inf,
    ]
    assert first["gs0"][0]["min_range"] == first["gs0"][0]["max_range"] == pytest.approx(0.008)


def test_the_scan_has_a_wall_ahead_at_its_distance_from_the_centre() -> None:
    model = MODELS["khepera4"]
    law = calibration_of(model).proximity
    counts = law.gain_counts_mm2[3] / (100 + law.offset_mm[3]) ** 2 - law.threshold_counts[3]
    proximity = [[96, 96, 96, counts, *[96] * 8]]
    (scan,) = read(model, proximity=proximity, ultrasonic=[[100, 1000, 0, 1000, 1000]])["scan"]
    front, left = len(scan["ranges"]) // 2, len(scan["ranges"]) * 3 // 4
    assert scan["angle_min"] + front * scan["angle_increment"] == pytest.approx(0, abs=1e-6)
    # The infrared sensor measures what is too near for the ultrasonic one.
    assert scan["ranges"][front] == pytest.approx(0.068 + 0.1, abs=1e-4)
    assert scan["ranges"][left] == pytest.approx(0.066 + 1.0)
    assert sum(map(math.isfinite, scan["ranges"])) == 2
    assert scan["range_min"] < scan["ranges"][front] < scan["range_max"]


def test_gravity_points_up_and_turns_to_the_left_are_positive() -> None:
    messages = read(MODELS["khepera4"], accelerometer=[[0, 0, -16384]], gyroscope=[[0, 0, 1000]])
    (imu,) = messages["imu"]
    assert imu["linear_acceleration"] == {"x": 0, "y": 0, "z": pytest.approx(9.80665)}
    assert imu["angular_velocity"]["z"] == pytest.approx(math.radians(66))
    assert imu["orientation_covariance"][0] == -1


def test_batteries_have_volts_amperes_and_ampere_hours() -> None:
    (fourth,) = read(MODELS["khepera4"], battery=[[800, -6000, 2000, 6400]])["battery_state"]
    (third,) = read(MODELS["khepera3"], battery=[[7400, -300, 1200]])["battery_state"]
    (scout,) = read(SCOUT, battery=[[7000]])["battery_state"]
    names = "voltage", "current", "charge", "temperature"
    assert [fourth[name] for name in names] == pytest.approx([7.808, -0.4686, 3.2, 25], rel=1e-6)
    assert [third[name] for name in names] == pytest.approx([7.4, -0.3, 1.2, math.nan], rel=1e-6, nan_ok=True)
    assert scout["voltage"] == pytest.approx(7)
    assert math.isnan(scout["percentage"])


def test_light_of_a_lamp_is_lux_at_the_sensor() -> None:
    model = MODELS["khepera4"]
    law = calibration_of(model).ambient
    counts = law.dark_counts - law.gain_counts_mm2_per_w[0] * 2 / 400**2  # 2 W at 400 mm
    messages = read(model, ambient=[[counts, *[law.dark_counts] * 11]])
    assert messages["ls0"][0]["illuminance"] == pytest.approx(10 * 2 / (4 * math.pi * 0.4**2))
    assert messages["ls1"][0]["illuminance"] == 0
    assert "ls8" not in messages


def test_an_image_of_the_line_camera_is_one_row_of_greys() -> None:
    greys = np.arange(64)[None]
    ((image),) = read(MODELS["khepera1"], vision=greys.tolist())["vision/image_raw"]
    assert (image["height"], image["width"], image["encoding"], image["data"]) == (
        1,
        64,
        "mono8",
        [*range(64)],
    )


@pytest.mark.parametrize("name", MODELS)
def test_each_sensor_has_a_frame_whose_x_axis_is_its_beam(name: str) -> None:
    model = MODELS[name]
    transforms = {child: (parent, pose) for parent, child, pose in standard(model).static_transforms()}
    assert {parent for parent, _ in transforms.values()} == {"khepera0/base_link"}
    headings = calibration_of(model).heading_deg
    for index, (place, heading) in enumerate(zip(model.body.sensor_positions, headings, strict=True)):
        pose = transforms[f"khepera0/ps{index}"][1]
        assert pose[:3] == (*place, model.body.sensor_height)
        assert 2 * math.atan2(pose[5], pose[6]) == pytest.approx(math.radians(heading))
    assert sum(frame.startswith("khepera0/gs") for frame in transforms) == len(model.body.ground_positions)
    assert sum(frame.startswith("khepera0/us") for frame in transforms) == len(
        getattr(model.body.sonar, "names", ())
    )
