"""Both Khepera IIIs in the tools that serve a robot of any model."""

from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from numba_marks import with_numba

from khep_twin import Network, rollout
from khep_twin.board.fault_injection import parse_fault
from khep_twin.host.connection import connect
from khep_twin.host.host_robot import open_robot
from khep_twin.lab.experiment.branch import BranchPlan, branch
from khep_twin.lab.report.rows import definitions
from khep_twin.lab.sensor_test.sensor_files import load, save
from khep_twin.lab.sensor_test.sensor_test import SensorTest, sense
from khep_twin.log.reader import read_log
from khep_twin.log.recorded import BranchPoint
from khep_twin.playpen import Playpen, parse
from khep_twin.ports.protocol_khep import Serial
from khep_twin.ports.twin import TwinOptions, open_twin
from khep_twin.robots.khepera3.model import MODELS, SAMPLED
from khep_twin.robots.khepera3.registers import MotorRegister as R
from khep_twin.robots.registry import find_model
from khep_twin.shadow.recording import read_recording
from khep_twin.world import World

NAMES = [model.name for model in MODELS]
CHANNELS = {channel.name: channel.registers for channel in SAMPLED}
ROBOT = '[[robot]]\nmodel = "{}"\nx_mm = {}\ny_mm = 300\nheading_deg = {}\n'
PEN = 'version = 1\nname = "pen"\n[arena]\nwidth_mm = 1000\nheight_mm = 600\n'
STEP_S, ORDER = 0.5, b"D,l15000,l12000\n"


def pen(*robots: tuple[str, float, float], battery: str = "") -> Playpen:
    """Return a pen with robots: model, position [mm] and heading [deg]."""
    return parse("".join([PEN, *(ROBOT.format(*robot) + battery for robot in robots)]), "pen")


@pytest.mark.parametrize("name", NAMES)
def test_a_sensor_test_drives_as_far_as_it_shall_by_the_pulses_of_the_generation(
    name: str, tmp_path: Path
) -> None:
    with connect(f"khep://arena3?model={name}") as robot:
        start = np.array(open_pose(robot))
        run = sense(robot, SensorTest(linear_cm=5, model=robot.model.name))
        way = np.linalg.norm(np.array(open_pose(robot)) - start)
    save(tmp_path / "run.csv", run)
    assert way == pytest.approx(0.05, abs=0.002)
    assert load(tmp_path / "run.csv").travelled[-1] == pytest.approx(5, abs=0.1)
    assert f", of a {find_model(name).title} {1000 * robot.model.body.pulse_length:.4f} mm" in str(
        definitions()
    )


def open_pose(robot: Any) -> tuple[float, float]:
    """Return the position of the twin at a port in this process [m]."""
    return robot.port.twin.world.robots[0].pose[:2]


@pytest.mark.parametrize("name", NAMES)
def test_dead_sensors_of_all_kinds_see_nothing_and_the_dark(name: str) -> None:
    sensors = find_model(name).body.fault_sensors
    faults = [parse_fault(f"dead:{sensor}") for sensor in sensors]
    world = World(pen((name, 500, 0)), noise=False, compiled=False, faults=faults)
    world.robots[0].send(b"C,0,31\n")
    world.advance(0.3)
    readings = world.robots[0].readings()
    assert readings["proximity"] == [0] * 11
    assert readings["ambient"] == [4095] * 11
    assert readings["ultrasonic"] == [0] * 5


def test_two_robots_see_each_other_and_a_robot_of_another_model() -> None:
    three = pen(("khepera3", 300, 0), ("khepera3-firmware2", 480, 180), ("khepera4", 800, 0))
    nose = [World(three, noise=False).robots[index].readings()["proximity"][3:5] for index in range(2)]
    alone = World(pen(("khepera3", 300, 0)), noise=False).robots[0].readings()["proximity"][3:5]
    assert min(*nose[0], *nose[1]) > 3 * max(alone)


def test_an_empty_battery_stops_and_darkens_the_robot_in_its_readings_too() -> None:
    world = World(pen(("khepera3", 500, 0), battery="battery_used_min = 239.995\n"), compiled=False)
    world.robots[0].send(b"K,0,1\n" + ORDER)
    world.advance(1.5)
    readings = world.robots[0].readings()
    assert not world.robots[0].firmware.powered
    assert (readings["speed"], readings["duty"], readings["leds"]) == ([0] * 4, [0] * 2, [0] * 2)
    assert readings["battery"] == [6000, 0, 0]


@pytest.mark.parametrize("name", NAMES)
def test_a_controller_continues_a_logged_run(name: str, tmp_path: Path) -> None:
    log = tmp_path / "run.mcap"
    with open_twin(pen((name, 300, 0)), TwinOptions(log=str(log))) as twin:
        twin.world.robots[0].send(ORDER)
        twin.world.advance(STEP_S)
    plan = BranchPlan(log, BranchPoint(400_000_000), lambda robot: robot.set_speed(0.05, -0.05), seconds=0.3)
    branch(plan, tmp_path / "new.mcap")
    (track,) = read_log(tmp_path / "new.mcap").robots.values()
    assert track.model.name == name
    unit = find_model(name).body.pulse_length * 1e2 / find_model(name).episode_interface.speed_per_pulse
    assert track.registers[-1, CHANNELS["speed"][2:]] * unit == pytest.approx([0.05, -0.05], rel=1e-3)


@pytest.mark.parametrize("rom", ["3.0", "kh3server"])
def test_a_program_at_a_port_reads_the_registers_of_all_terms(rom: str) -> None:
    twin = open_twin(pen(("khepera3", 300, 0)), TwinOptions(rom=rom, noise=False))
    with open_robot(twin.robot_model, Serial.of(twin, 1.0)) as robot:
        robot.ask("C,0,d31")
        robot.sleep(STEP_S)
        registers = [
            index
            for term in robot.model.terms
            for index in range(term.register, term.register + len(term.names))
        ]
        values = robot.read_registers(registers)
        readings = twin.world.robots[0].readings()
    assert values[2:] == readings["ultrasonic"] != [0] * 5
    assert values[:2] == readings["proximity"][9:]


def test_a_log_without_a_line_becomes_requests_that_its_robot_answers(tmp_path: Path) -> None:
    log = tmp_path / "run.mcap"
    with open_twin(pen(("khepera3", 300, 0)), TwinOptions(log=str(log))) as twin:
        for motor in cast(Any, twin.world.robots[0]).bus.motors:
            for register, size, value in ((R.MODE, 1, 1), (R.CONTROL, 1, 3), (R.SET_POINT, 4, 15_000)):
                motor.set(register, size, value)
        twin.world.advance(STEP_S)
    (robot,) = World(pen(("khepera3", 300, 0)), noise=False).robots
    requests = [chunk.data for chunk in read_recording(log).chunks if chunk.to_robot]
    assert any(request.startswith(b"L,l-3") for request in requests)
    for request in requests:
        assert robot.firmware.receive(request).startswith(request[:1].lower())


@with_numba
@pytest.mark.parametrize("planar", [True, pytest.param(False, marks=pytest.mark.long)])
def test_compiled_episodes_equal_plain_ones(planar: bool) -> None:
    network = Network(hidden=(3,), ambient=True, terms=("ultrasonic", "ground"), model="khepera3")
    genes = np.random.default_rng(5).normal(size=(2, network.n_genes))
    plain, compiled = (
        rollout("arena3", network, range(2), 0.4, genes=genes, planar=planar, compiled=compiled)
        for compiled in (False, True)
    )
    assert (plain.registers == compiled.registers).all()
    assert (plain.poses == compiled.poses).all()
    # All ultrasonic sensors measure, not only the one that is active at power-up.
    assert ((plain.registers[:, CHANNELS["ultrasonic"]] > 0).sum(axis=1) > 2).all()
