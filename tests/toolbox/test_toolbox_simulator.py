"""The toolbox's simulated commands, without the limits of its simulator."""

import math
from pathlib import Path

import numpy as np
import pytest
from scenes import arena, robot
from scipy.io import savemat

from khep_twin import playpen as playpens
from khep_twin import toolbox
from khep_twin.errors import BitmapError, PlaypenError, PortError
from khep_twin.log.reader import read_log
from khep_twin.playpen import Playpen
from khep_twin.toolbox.simulator import OpenPlaypen

PULSE = 80e-6
WHEEL_BASE = 0.052


@pytest.fixture
def btmap1(field: Playpen) -> OpenPlaypen:
    return toolbox.open_custom(field, noise=False)


def run_cycles(btmap1: OpenPlaypen, count: int) -> None:
    for _ in range(count):
        toolbox.kheprom(btmap1)


def wait_until_arrived(btmap1: OpenPlaypen) -> None:
    run_cycles(btmap1, 1)
    while not toolbox.sim_rmc(2)[[0, 3]].all():
        run_cycles(btmap1, 1)
        assert btmap1.time < 100


def test_a_simulated_command_takes_no_time_and_kheprom_takes_a_cycle(btmap1: OpenPlaypen) -> None:
    toolbox.sim_spc(2, 5, 6)
    toolbox.sim_sms(2, 3, 3)
    assert toolbox.sim_rpc(2).tolist() == [5, 6]
    for command in (toolbox.sim_rms, toolbox.sim_rmc, toolbox.sim_rps, toolbox.sim_rls):
        command(2)
    toolbox.sim_skp(2, 100, 100)
    assert btmap1.time == 0
    toolbox.kheprom(btmap1)
    assert btmap1.time == 0.05
    toolbox.kheprom(btmap1, 0.02)
    assert btmap1.time == 0.07


def test_a_speed_of_1_moves(btmap1: OpenPlaypen) -> None:
    toolbox.sim_sms(2, 1, 1)
    run_cycles(btmap1, 40)
    # 8 mm/s for 2 s, minus 0.2 s until the controller's integral overcomes the gears' friction.
    assert btmap1.twin.robot.pose[0] == pytest.approx(1.5144, abs=1e-3)
    assert np.abs(toolbox.sim_rpc(2) - 182).max() <= 3


def test_speeds_have_sizes(btmap1: OpenPlaypen) -> None:
    distances = []
    for speed in (2, 20, -10):
        toolbox.sim_sms(2, speed, speed)
        run_cycles(btmap1, 10)
        start_x = btmap1.twin.robot.pose[0]
        run_cycles(btmap1, 20)
        distances.append(btmap1.twin.robot.pose[0] - start_x)
        assert np.abs(toolbox.sim_rms(2) - speed).max() <= 1
    assert distances == pytest.approx([0.016, 0.16, -0.08], rel=0.03)


def test_unequal_speeds_drive_an_arc(btmap1: OpenPlaypen) -> None:
    toolbox.sim_sms(2, 5, 10)
    run_cycles(btmap1, 10)
    x, y, heading = btmap1.twin.robot.pose
    run_cycles(btmap1, 40)
    # Its radius is half the wheel base x (5 + 10) / (10 - 5).
    radius = WHEEL_BASE / 2 * 3
    turned = 2 * 0.04 / WHEEL_BASE
    x1, y1, heading1 = btmap1.twin.robot.pose
    assert heading1 - heading == pytest.approx(turned, rel=0.02)
    assert math.hypot(x1 - x, y1 - y) == pytest.approx(2 * radius * math.sin(turned / 2), rel=0.02)


def test_distance_and_turn_are_combined_and_the_counters_stay_right(btmap1: OpenPlaypen) -> None:
    for target in ((1000, 1000), (490, 1510), (1490, 2010), (0, 0)):
        toolbox.sim_skp(2, *target)
        wait_until_arrived(btmap1)
        left, right = toolbox.sim_rpc(2)
        assert np.abs(np.array([left, right]) - target).max() <= 2
        turned = (right - left) * PULSE / WHEEL_BASE
        heading = btmap1.twin.robot.pose[2]
        assert math.remainder(heading - turned, 2 * math.pi) == pytest.approx(0, abs=0.02)


def test_counters_set_in_mid_course_count_on(btmap1: OpenPlaypen) -> None:
    toolbox.sim_sms(2, 10, 10)
    run_cycles(btmap1, 20)
    toolbox.sim_spc(2, -1000, 1000)
    run_cycles(btmap1, 20)
    assert toolbox.sim_rpc(2) == pytest.approx([0, 2000], abs=15)


def test_a_newer_command_supersedes(btmap1: OpenPlaypen) -> None:
    toolbox.sim_skp(2, 5000, 5000)
    run_cycles(btmap1, 10)
    toolbox.sim_sms(2, 0, 0)
    run_cycles(btmap1, 20)
    assert toolbox.sim_rmc(2)[1] == 0
    assert toolbox.sim_rms(2).tolist() == [0, 0]
    assert toolbox.sim_rpc(2)[0] < 1000


def test_the_speed_is_read_in_position_mode_too(btmap1: OpenPlaypen) -> None:
    toolbox.sim_skp(2, 5000, 5000)
    run_cycles(btmap1, 40)
    assert toolbox.sim_rms(2) == pytest.approx([20, 20], abs=2)


def test_the_controllers_error_is_reported(btmap1: OpenPlaypen) -> None:
    toolbox.sim_sms(2, 40, -40)
    toolbox.kheprom(btmap1, 0.01)
    left, right = toolbox.sim_rmc(2)[[2, 5]]
    assert left > 10
    assert right < -10
    run_cycles(btmap1, 20)
    assert np.abs(toolbox.sim_rmc(2)[[2, 5]]).max() <= 2
    toolbox.sim_skp(2, 9000, 9000)
    run_cycles(btmap1, 20)
    control = toolbox.sim_rmc(2)
    assert control[[0, 3]].tolist() == [0, 0]
    assert (control[[2, 5]] != 0).all()


def test_modes_are_counted_as_the_rom_says(field: Playpen) -> None:
    modes = {}
    for rom in ("5.02", "4.06"):
        toolbox.open_custom(field, rom=rom)
        toolbox.sim_sms(2, 1, 1)
        speed = toolbox.sim_rmc(2)[1]
        toolbox.sim_skp(2, 9, 9)
        modes[rom] = (speed, toolbox.sim_rmc(2)[1])
    assert modes == {"5.02": (0, 1), "4.06": (1, 0)}


def test_several_robots_are_distinguished_by_their_number() -> None:
    btmap1 = toolbox.open_custom(
        playpens.parse(arena() + robot(150, 250) + robot(450, 250, 90), "two"), noise=False
    )
    toolbox.sim_sms(1, 5, 5)
    toolbox.sim_sms(2, -3, 3)
    run_cycles(btmap1, 20)
    one, two = (robot.pose for robot in btmap1.twin.robots)
    assert one[0] > 0.18
    assert one[2] == pytest.approx(0, abs=0.02)
    assert two[:2] == pytest.approx((0.45, 0.25), abs=2e-3)
    assert two[2] > math.pi / 2 + 0.5
    assert toolbox.userdata(btmap1, 2)[:2] == pytest.approx([450, 250], abs=2)
    with pytest.raises(PortError, match="port_id = 3: no such robot"):
        toolbox.sim_rps(3)


def test_the_same_seed_and_commands_give_the_same_run() -> None:
    runs = []
    for seed in (1, 1, 2):
        btmap1 = toolbox.open_custom("obstacles", seed=seed)
        readings = []
        for _ in range(40):
            toolbox.sim_sms(2, 6, 4)
            readings.append([*toolbox.sim_rps(2), *toolbox.sim_rls(2)])
            toolbox.kheprom(btmap1)
        runs.append((readings, btmap1.twin.robot.pose))
    assert runs[0] == runs[1] != runs[2]


def test_userdata_has_the_toolboxs_31_columns(btmap1: OpenPlaypen) -> None:
    toolbox.sim_spc(2, 7, 8)
    toolbox.sim_skp(2, 11, 12)
    toolbox.sim_sms(2, 3, 4)
    row = toolbox.userdata(btmap1)
    assert row.shape == (31,)
    assert row[:3] == pytest.approx([1500, 2500, 0], abs=0.1)
    assert row[3:19].tolist() == [*toolbox.sim_rps(2), *toolbox.sim_rls(2)]
    assert row[19:21].tolist() == [3, 4]
    assert row[21:27].tolist() == toolbox.sim_rmc(2).tolist()
    assert row[27:31].tolist() == [7, 8, 11, 12]


@pytest.mark.parametrize("kind", ["array", "file"])
def test_a_scanned_playpen_is_opened_the_right_way_up(tmp_path: Path, kind: str) -> None:
    # A block in the upper left corner; the last row of the scan is the upper one.
    drawn = np.ones((500, 600))
    drawn[40:60, 50:110] = 44
    scan = np.flipud(drawn)
    savemat(tmp_path / "defmap.mat", {"btmap1": scan})
    btmap1 = toolbox.open_custom(scan if kind == "array" else tmp_path / "defmap.mat")
    (block,) = btmap1.twin.world.playpen.blocks
    assert (block.x_mm, block.y_mm) == (80, 450)
    toolbox.kheprom(btmap1)


def test_a_run_in_the_simulator_is_recorded(tmp_path: Path) -> None:
    log = tmp_path / "run.mcap"
    btmap1 = toolbox.open_custom("default", log=str(log))
    toolbox.sim_sms(2, 5, 5)
    run_cycles(btmap1, 10)
    toolbox.close_playpen()
    track = read_log(log).robots["khepera0"]
    assert track.times_ns[-1] == 500_000_000
    assert [line.text for line in track.serial][:2] == ["D,5,5", "d"]


def test_without_a_playpen_the_error_says_how_to_open_one(btmap1: OpenPlaypen) -> None:
    other = toolbox.open_default()
    with pytest.raises(PlaypenError, match="btmap1 is not the playpen that is open"):
        toolbox.kheprom(btmap1)
    toolbox.close_playpen()
    for command in (lambda: toolbox.sim_rps(2), lambda: toolbox.kheprom(other)):
        with pytest.raises(PlaypenError, match="no playpen is open; expected btmap1 = "):
            command()


def test_what_cannot_be_opened_leaves_open_what_is(btmap1: OpenPlaypen) -> None:
    nobody = playpens.parse(arena(), "nobody")
    for wrong, error, message in (
        (nobody, PlaypenError, "p: no robot stands in it"),
        ("no-such", PlaypenError, "no-such"),
        (np.ones(7), BitmapError, "btmap1: 1 dimensions"),
        (np.full((500, 600), 44), BitmapError, "every pixel is solid"),
    ):
        with pytest.raises(error, match=message):
            toolbox.open_custom(wrong)
    toolbox.kheprom(btmap1)
