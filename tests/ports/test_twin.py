"""Twins from options: defaults of each model, and invalid options."""

import pytest
from scenes import arena, robot

from khep_twin.board.uart import LineSettings
from khep_twin.errors import PortError
from khep_twin.host import Khepera
from khep_twin.playpen import Playpen, parse
from khep_twin.ports.protocol_khep import Serial
from khep_twin.ports.twin import Twin, TwinOptions, equip_playpen, open_twin

OWN_SENSORS = arena() + robot(300, 250, model="khepera2", calibration="khepera1-manual")


def test_a_model_brings_its_sensors_and_its_firmware() -> None:
    with open_twin("default", TwinOptions(model="khepera2", mode=9)) as twin:
        entry = twin.world.playpen.robots[0]
        assert (entry.model, entry.calibration, entry.rom) == ("khepera2", "khepera2", "khepera2")
        assert twin.robot.firmware.baud == 115200
        assert twin.robot.disc[2] == 0.035


def test_a_version_of_the_firmware_that_is_given_stays() -> None:
    scene, _ = equip_playpen("default", TwinOptions(model="khepera2", rom="5.02"))
    assert (scene.robots[0].calibration, scene.robots[0].rom) == ("khepera2", "5.02")


def test_a_robot_that_is_of_the_model_keeps_its_own_sensors() -> None:
    scene, _ = equip_playpen(parse(OWN_SENSORS, "own"), TwinOptions(model="khepera2"))
    assert scene.robots[0].calibration == "khepera1-manual"
    scene, _ = equip_playpen(parse(OWN_SENSORS, "own"), TwinOptions(model="khepera1"))
    assert (scene.robots[0].calibration, scene.robots[0].rom) == ("khepera1", "5.02")


def test_only_the_robot_on_the_line_changes() -> None:
    scene, indices = equip_playpen(
        parse(OWN_SENSORS.replace("khepera2", "khepera1") + robot(100, 100), "two"),
        TwinOptions(robot=1, model="khepera2"),
    )
    assert list(indices) == [1]
    assert [entry.model for entry in scene.robots] == ["khepera1", "khepera2"]


def test_a_larger_body_that_has_no_room_is_refused_with_what_is_in_its_way() -> None:
    near = Playpen.load("default")
    robots = (near.robots[0].model_copy(update={"x_mm": 30.0}),)
    with pytest.raises(PortError, match=r"with model = 'khepera2': robot 1 .* overlaps the left"):
        equip_playpen(near.model_copy(update={"robots": robots}), TwinOptions(model="khepera2"))


def test_an_unknown_model_is_reported_with_the_choices() -> None:
    with pytest.raises(PortError, match=r"model = 'khepera5': unknown; .*\(choices: khepera1, .*khepera4\)"):
        TwinOptions(model="khepera5")


def test_a_host_that_tries_many_speeds_is_warned_a_hundred_times_at_most() -> None:
    with open_twin("default", TwinOptions()) as twin:
        warnings = [twin.robot.set_host_line(LineSettings(baud, 2)) for baud in range(1000, 2000)]
    assert sum(map(bool, warnings)) == 100


class LateSource:
    """Time source that stores the requested times, and advances the world."""

    def __init__(self, twin: Twin) -> None:
        self.twin = twin
        self.goals: list[int] = []
        self.attended = 0

    def advance_to(self, time_ns: int) -> None:
        self.goals.append(time_ns)
        self.twin.world.advance_to(time_ns)

    def attend(self) -> None:
        self.attended += 1


def test_a_port_lets_time_pass_by_the_source_of_its_twin() -> None:
    twin = open_twin("default", TwinOptions())
    source = LateSource(twin)
    with Khepera(Serial.of(Twin(twin.world, twin.robots, twin.options, source), timeout=1.0)) as host:
        host.set_speed(1, 1)
        host.sleep(0.1)
    assert source.attended > 0
    assert source.goals[-1] == twin.world.time_ns
    assert source.goals == sorted(source.goals)


def test_a_twin_without_a_source_advances_at_once() -> None:
    with open_twin("default", TwinOptions()) as twin:
        twin.advance_to(50_000_000)
        assert twin.world.time_ns == 50_000_000
