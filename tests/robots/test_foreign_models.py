"""Models outside the product in tables, views and pages, and on the line: their units, LEDs and words."""

from pathlib import Path

import numpy as np
import pytest

from khep_twin import playpen as playpens
from khep_twin import read_log
from khep_twin.host.host_robot import open_robot
from khep_twin.log.columns import name_columns
from khep_twin.log.viewer.replay import view
from khep_twin.playpen import Playpen
from khep_twin.ports.protocol_khep import Serial
from khep_twin.ports.twin import TwinOptions, open_twin
from khep_twin.robots.registry import find_model
from khep_twin.web.twin_session import TwinActor
from tests.log.log_contents import values_of
from tests.web.conftest import Inbox

pytestmark = pytest.mark.usefixtures("installed_robots")


@pytest.fixture
def pair() -> Playpen:
    """A Scout and a Toy in a playpen."""
    robots = "".join(
        f'[[robot]]\nmodel = "{model}"\nx_mm = {x}\ny_mm = 300\nheading_deg = 0\n'
        for model, x in (("scout", 200), ("toy", 500))
    )
    return playpens.parse(
        f'version = 1\nname = "pair"\n[arena]\nwidth_mm = 900\nheight_mm = 600\n{robots}', "pair"
    )


def test_channels_of_several_models_with_other_columns_have_the_family_in_their_names() -> None:
    scout, toy, khepera4 = map(find_model, ("scout", "toy", "khepera4"))
    families = {"scout", "toy"}
    assert name_columns("ultrasonic", 3, scout, families)[0] == "ultrasonic"
    assert name_columns("ultrasonic", 1, toy, families) == (
        "toy_ultrasonic",
        (("toy_ultrasonic_beacon", "mm"),),
    )
    assert name_columns("ultrasonic", 3, scout, families | {"khepera4"})[0] == "scout_ultrasonic"
    assert name_columns("ultrasonic", 5, khepera4, families | {"khepera4"})[0] == "ultrasonic"
    assert name_columns("ultrasonic", 1, toy, {"toy"})[0] == "ultrasonic"


def test_a_view_has_beams_in_the_unit_of_the_model_and_its_leds(pair: Playpen, tmp_path: Path) -> None:
    with open_robot(
        find_model("scout"), Serial.of(open_twin(pair, TwinOptions(log=tmp_path / "run.mcap")), 1.0)
    ) as robot:
        assert robot.ask("lamp 63 0 0") == "0"
        robot.sleep(0.3)
    view([tmp_path / "run.mcap"], save=tmp_path / "run.rrd")
    track = read_log(tmp_path / "run.mcap").robots["khepera0"]
    time_ns, strips = values_of(
        tmp_path / "run.rrd", "/obstacles/khepera0_ultrasonic", "LineStrips3D:strips"
    )[-1]
    readings = track.extra_channels["ultrasonic"][track.times_ns.tolist().index(time_ns)]
    assert np.array(strips[1])[5][0] == pytest.approx(0.095 + readings[1] / 1000, abs=1e-4)
    _, colours = values_of(tmp_path / "run.rrd", "/obstacles/khepera0_leds", "Ellipsoids3D:colors")[-1]
    assert [int(colour) >> 8 for colour in colours] == [0xFF0000]


def test_a_page_shows_robots_without_leds_and_the_unit_of_their_distances(pair: Playpen) -> None:
    inbox = Inbox()
    actor = TwinActor(pair, TwinOptions(), None, inbox)
    actor.begin()
    shapes = inbox.wait("twin")["robots"]
    assert [(shape["sonar_unit_mm"], shape["sonar_codes"]) for shape in shapes] == [
        (1.0, (0, 9999)),
        (1.0, (0,)),
    ]
    assert [robot["leds"] for robot in inbox.wait("picture")["robots"]] == [[0, 0, 0], []]
    actor.end()


def test_a_word_has_one_reply_where_its_dialect_has_no_tools(pair: Playpen) -> None:
    with open_robot(find_model("scout"), Serial.of(open_twin(pair), 1.0)) as robot:
        start = robot.time
        assert len(robot.ask("look").split()) == 10
        assert robot.time - start < 0.02
