"""Placing, moving and turning the simulated robot, and detection of obstacles."""

import math
from pathlib import Path

import pytest

from khep_twin import playpen as playpens
from khep_twin import toolbox
from khep_twin.errors import PlaypenError
from khep_twin.lab.experiment.repeat import repeat
from khep_twin.log.reader import read_series
from khep_twin.log.recorded import read_recorded_run
from khep_twin.toolbox.simulator import OpenPlaypen

ARENA = 'version = 1\nname = "p"\n[arena]\nwidth_mm = 600\nheight_mm = 500\n'
ROBOT = "[[robot]]\nx_mm = {}\ny_mm = {}\nheading_deg = {}\n"
BLOCK = "[[block]]\nx_mm = 450\ny_mm = 250\nlength_mm = 60\nwidth_mm = 20\nheight_mm = 50\n"
CYLINDER = "[[cylinder]]\nx_mm = 360\ny_mm = 250\nradius_mm = 10\nheight_mm = 40\nmovable = true\n"
LAMP = "[[lamp]]\nx_mm = 500\ny_mm = 450\npower_w = 7\n"


def open_playpen(*parts: str) -> OpenPlaypen:
    return toolbox.open_custom(playpens.parse(ARENA + "".join(parts), "p"), noise=False)


def pose(btmap1: OpenPlaypen, port_id: int = 1) -> list[float]:
    return toolbox.userdata(btmap1, port_id)[:3].tolist()


def test_a_robot_is_put_where_there_is_room_and_senses_what_is_there() -> None:
    btmap1 = open_playpen(ROBOT.format(300, 250, 90), BLOCK)
    toolbox.sim_sms(1, 5, 5)
    toolbox.kheprom(btmap1, 1)
    toolbox.putkhep(380, 250, 0)
    assert pose(btmap1) == pytest.approx([380, 250, 0])
    assert toolbox.sim_rpc(1).tolist() == [0, 0]
    toolbox.kheprom(btmap1)
    # 12.5 mm of floor between the sensors ahead and the block; behind there is none.
    assert toolbox.sim_rps(1)[2:4].min() > 500
    assert toolbox.sim_rps(1)[6:].max() < 50
    toolbox.kheprom(btmap1, 1)
    # The speed controller takes some time to stop.
    assert pose(btmap1)[:2] == pytest.approx([380, 250], abs=1)
    assert abs(toolbox.sim_rpc(1)).max() <= 12


def test_a_robot_that_drove_is_put_down_at_rest_with_its_board_as_after_a_reset() -> None:
    btmap1 = toolbox.open_default(noise=False)
    fresh = toolbox.userdata(btmap1)
    toolbox.sim_skp(1, 3000, 3000)
    toolbox.sim_sms(1, 100, 100)
    toolbox.kheprom(btmap1, 0.3)
    toolbox.putkhep(100, 250, 0)
    placed = toolbox.userdata(btmap1)
    assert placed[:3].tolist() == [100, 250, 0]
    # Speeds, [T, M, E] twice, counters and targets.
    assert placed[19:].tolist() == fresh[19:].tolist()
    assert toolbox.sim_rms(1).tolist() == [0, 0]
    toolbox.kheprom(btmap1, 1)
    later = toolbox.userdata(btmap1)
    assert later[:2] == pytest.approx([100, 250], abs=0.05)
    assert toolbox.cvrtang(later[2]) == pytest.approx(0, abs=0.05)
    assert later[19:].tolist() == fresh[19:].tolist()


def test_the_sensors_of_a_robot_are_right_as_soon_as_it_is_put_down() -> None:
    btmap1 = toolbox.open_default(noise=False)
    toolbox.kheprom(btmap1, 0.0325)  # in the middle of a scan
    toolbox.putkhep(40, 250, 180)
    readings = toolbox.sim_rps(1)
    assert readings[2:4].min() > 700
    toolbox.kheprom(btmap1, 0.1)
    assert toolbox.sim_rps(1) == pytest.approx(readings, abs=2)
    toolbox.putkhep(300, 250, 180)
    assert toolbox.sim_rps(1).max() < 30


def test_a_log_repeats_what_the_toolbox_did_to_robot_and_lamps(tmp_path: Path) -> None:
    btmap1 = toolbox.open_custom("two-lamps", seed=3, log=tmp_path / "run.mcap", lighting="sequenced")
    for x_mm in (100, 300):
        toolbox.putkhep(x_mm, 100, 90)
        toolbox.sim_sms(1, 10, 9)
        toolbox.kheprom(btmap1, 0.5)
        toolbox.place_lamp(x_mm, 300, 5)
        toolbox.kheprom(btmap1, 0.3)
        toolbox.upsv(btmap1)
    toolbox.close_playpen()
    assert repeat(read_recorded_run(tmp_path / "run.mcap")) is None
    lamps = {
        topic: channel.values.shape[1] for topic, channel in read_series(tmp_path / "run.mcap").series.items()
    }
    assert [lamps[topic] for topic in ("/lamps", "/lamps_2", "/lamps_3")] == [2, 3, 4]


@pytest.mark.parametrize(("angle", "equal"), [(190, -170), (-190, 170), (90, 90), (720, 0), (-180, -180)])
def test_an_angle_is_converted_to_under_180_degrees(angle: float, equal: float) -> None:
    assert toolbox.cvrtang(angle) == pytest.approx(equal)


def test_without_a_heading_it_looks_where_it_looked() -> None:
    btmap1 = open_playpen(ROBOT.format(300, 250, 33))
    toolbox.putkhep(100, 100)
    assert pose(btmap1) == pytest.approx([100, 100, 33], abs=0.1)


@pytest.mark.parametrize(
    ("x_mm", "y_mm", "message"),
    [
        (450, 255, "overlaps block 1 at"),
        (10, 100, "overlaps the left wall at x = 0; expected 17.5 mm further in"),
        (300, 495, "overlaps the top wall"),
        (700, 100, "outside the arena"),
        (-1e9, 100, "overlaps the left wall"),
        (float("nan"), 100, "expected finite numbers"),
        (300, 250, "overlaps robot 2"),
    ],
)
def test_a_robot_is_not_put_onto_a_wall_or_an_object(x_mm: float, y_mm: float, message: str) -> None:
    btmap1 = open_playpen(BLOCK, ROBOT.format(100, 250, 0), ROBOT.format(300, 260, 0))
    old_pose = pose(btmap1)
    with pytest.raises(PlaypenError, match=f"putkhep: .*{message}"):
        toolbox.putkhep(x_mm, y_mm)
    assert pose(btmap1) == old_pose


def test_there_is_room_where_a_movable_thing_has_gone_and_none_where_it_is() -> None:
    btmap1 = open_playpen(ROBOT.format(300, 250, 0), CYLINDER)
    toolbox.sim_sms(1, 10, 10)
    toolbox.kheprom(btmap1, 1.5)  # pushes it by about 10 cm
    toolbox.sim_sms(1, 0, 0)
    pushed = btmap1.twin.world.data.body("cylinder0").xpos * 1e3
    assert pushed[0] > 400
    with pytest.raises(PlaypenError, match="overlaps cylinder 1"):
        toolbox.putkhep(pushed[0], pushed[1] + 30)
    toolbox.putkhep(360, 320)
    toolbox.putkhep(330, 250)


def test_what_stands_close_ahead_or_behind_is_found() -> None:
    btmap1 = open_playpen(BLOCK, LAMP, ROBOT.format(300, 250, 0), ROBOT.format(100, 250, 0))
    assert toolbox.checkobj(btmap1) == (0, 0)
    for x_mm, y_mm, heading_deg, expected in (
        (392, 250, 0, (1, 0)),  # the block, half a millimetre ahead
        (392, 250, 180, (0, 1)),
        (390, 250, 0, (0, 0)),  # 2.5 mm are too far
        (392, 250, 90, (0, 0)),  # beside it, where the robot can drive along a wall
        (28, 28, 45, (0, 1)),  # in a corner, with walls at 45 degrees behind it
        (28, 250, 180, (1, 0)),  # the arena's wall
        (155.5, 250, 180, (1, 0)),  # the other robot
        (500, 421.5, 90, (0, 0)),  # robots pass through lamps
    ):
        toolbox.putkhep(x_mm, y_mm, heading_deg)
        assert toolbox.checkobj(btmap1) == expected, (x_mm, y_mm, heading_deg)


def test_a_robot_moves_5_mm_and_its_counters_tell() -> None:
    btmap1 = open_playpen(ROBOT.format(300, 250, 0))
    for dirn in (1, 1, 1, -1):
        toolbox.movekhep(dirn, btmap1)
    assert pose(btmap1)[:2] == pytest.approx([310, 250], abs=0.3)
    assert toolbox.sim_rpc(1) == pytest.approx([125, 125], abs=3)
    with pytest.raises(ValueError, match="dirn = 2; expected 1 for forward or -1"):
        toolbox.movekhep(2, btmap1)


@pytest.mark.parametrize("alpha", [90, -45, 15, 360])
def test_a_robot_turns_by_an_angle_to_the_left_above_0(alpha: float) -> None:
    btmap1 = open_playpen(ROBOT.format(300, 250, 0))
    toolbox.rotkhep(alpha)
    turned = math.remainder(pose(btmap1)[2] - alpha, 360)
    assert turned == pytest.approx(0, abs=1)
    pulses = math.radians(alpha) * 26 / 0.08
    assert toolbox.sim_rpc(1) == pytest.approx([-pulses, pulses], abs=3)


def test_before_a_wall_wheels_slip_and_count_on() -> None:
    btmap1 = open_playpen(ROBOT.format(572, 250, 0))
    for _ in range(4):
        toolbox.movekhep(1, btmap1)
    assert pose(btmap1)[0] <= 573
    assert toolbox.sim_rpc(1) == pytest.approx([250, 250], abs=8)
