"""Moving a robot manually in a running world."""

import math
from pathlib import Path

import pytest

from khep_twin.board.kernel import Wheel
from khep_twin.errors import PlaypenError
from khep_twin.host import Khepera
from khep_twin.interventions.move_robot import current_playpen, place_robot
from khep_twin.lab.experiment.controllers import braitenberg
from khep_twin.lab.experiment.repeat import repeat
from khep_twin.log.reader import read_log
from khep_twin.log.recorded import read_recorded_run
from khep_twin.playpen import Playpen, parse
from khep_twin.ports.twin import TwinOptions, open_twin

SECOND = 1_000_000_000


def test_a_robot_stands_where_it_was_put_and_its_counters_stay(field: Playpen) -> None:
    with open_twin(field, TwinOptions(noise=False)) as twin:
        twin.robot.send(b"D,10,5\n")
        twin.advance_to(SECOND)
        counted = twin.robot.registers[Wheel.ENCODER]
        assert counted > 0
        place_robot(twin.world, 0, 700, 800, 90)
        assert twin.robot.pose == pytest.approx((0.7, 0.8, math.pi / 2))
        assert twin.robot.registers[Wheel.ENCODER] == counted
        twin.robot.send(b"D,0,0\n")
        twin.advance_to(3 * SECOND)
        x, y, _ = twin.robot.pose
        # Its motors were on until the command arrived.
        assert math.dist((x, y), (0.7, 0.8)) < 0.02


def test_a_robot_that_lies_is_put_upright(field: Playpen) -> None:
    with open_twin(field, TwinOptions(noise=False)) as twin:
        model, data = twin.world.model, twin.world.data
        address = model.joint("khepera0/pose").qposadr[0]
        data.qpos[address + 2 : address + 7] = 0.05, 0, 1, 0, 0
        place_robot(twin.world, 0, 700, 800, 0)
        twin.advance_to(SECOND)
        assert data.xmat[model.body("khepera0/base").id, 8] > 0.999


def test_where_there_is_no_room_it_stays_where_it_was() -> None:
    with open_twin("two-lamps", TwinOptions()) as twin:
        before = twin.robot.pose
        for x_mm, y_mm, reason in ((5, 250, "wall"), (-100, 250, "left wall"), (math.nan, 0, "numbers")):
            with pytest.raises(PlaypenError, match=reason):
                place_robot(twin.world, 0, x_mm, y_mm, 0)
        assert twin.robot.pose == before


PUSHED = """
version = 1
name = "pushed"
[arena]
width_mm = 800
height_mm = 400
[[cylinder]]
x_mm = 300
y_mm = 200
radius_mm = 10
height_mm = 30
movable = true
mass_g = 10
[[robot]]
x_mm = 200
y_mm = 200
heading_deg = 0
"""


def test_what_was_pushed_away_leaves_room() -> None:
    with open_twin(parse(PUSHED, "pushed"), TwinOptions(noise=False)) as twin:
        with pytest.raises(PlaypenError, match="cylinder"):
            place_robot(twin.world, 0, 300, 200, 0)
        twin.robot.send(b"D,10,10\n")
        twin.advance_to(4 * SECOND)
        (moved,) = current_playpen(twin.world).cylinders
        assert moved.x_mm > 350
        place_robot(twin.world, 0, 300, 200, 0)


def test_a_log_repeats_where_a_robot_was_put(tmp_path: Path) -> None:
    with Khepera(f"khep://two-lamps?seed=3&log={tmp_path / 'run.mcap'}") as robot:
        for place in ((100, 100, 45), (500, 100, 135)):
            place_robot(robot.port.twin.world, 0, *place)
            while robot.time % 3 < 2.9:
                braitenberg(robot)
            robot.sleep(0.2)
    assert repeat(read_recorded_run(tmp_path / "run.mcap")) is None
    texts = [line.text for line in read_log(tmp_path / "run.mcap").events]
    assert "put to (500, 100), 135 degrees" in texts
