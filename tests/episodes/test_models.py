"""Episodes of robots that are no Kheperas: the same core and readings as in a world."""

from pathlib import Path

import numpy as np
import pytest

from khep_twin import Braitenberg, ConstantSpeed, Episode, Function, Network, Policy, World, rollout
from khep_twin.episodes.controllers import Driver
from khep_twin.episodes.episode_options import EpisodeOptions
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.errors import ControllerError, PlaypenError, RobotModelError
from khep_twin.playpen import Playpen, parse
from khep_twin.robots.khepera4.model import SAMPLED
from khep_twin.robots.khepera4.registers import Control, DspicRegister
from khep_twin.sensing import calibration

CHANNELS = {channel.name: slice(channel.registers[0], channel.registers[-1] + 1) for channel in SAMPLED}
GROUND = slice(8, 12)
INERTIAL = slice(CHANNELS["accelerometer"].start, CHANNELS["gyroscope"].stop)
TERMS = "ultrasonic", "ground"
NETWORK = Network(hidden=(3,), ambient=True, terms=(*TERMS, "gyroscope"), model="khepera4")
GENES = np.random.default_rng(5).normal(size=(2, NETWORK.n_genes))


def avoid(proximity, ambient, memory, genes, ultrasonic, ground):
    memory[0] += 1
    return 150.0 + memory[0] + ultrasonic[2] / 10, 150.0 if proximity[3] < 300 else -ground[1]


def policy(proximity, ambient, which, ultrasonic, ground):
    return np.stack([150.0 + ultrasonic[:, 2] / 10, ground[:, 1] / 5 + which], axis=1)


def orders_of(left: int, right: int) -> bytes:
    return bytes([DspicRegister.SPEED_ORDER_LEFT]) + b"".join(
        speed.to_bytes(2, "little", signed=True) for speed in (left, right)
    )


def test_an_episode_of_a_khepera_iv_is_a_world_of_it() -> None:
    world = World("arena4", seed=3, compiled=False)
    (robot,) = world.robots
    robot.dspic.write(bytes([DspicRegister.CONTROL, Control.SPEED]))  # type: ignore[attr-defined]
    robot.dspic.write(orders_of(300, 200))  # type: ignore[attr-defined]
    world.advance(1.0)
    readings = robot.readings()
    episode = Episode(EpisodeSetup("arena4"), ConstantSpeed(300, 200), compiled=False)
    episode.begin(seed=3)
    episode.run(1.0)
    assert episode.poses == world.poses
    registers = episode.read_registers()
    for name in readings.keys() - {"ultrasonic"}:  # evaluated when a program reads it
        assert registers[CHANNELS[name]].tolist() == readings[name], name


@pytest.mark.share(3)
@pytest.mark.parametrize(
    "driver", [Function(avoid, n_memory=1, terms=TERMS), NETWORK, Policy(policy, terms=TERMS)]
)
@pytest.mark.parametrize("planar", [False, True])
def test_compiled_episodes_of_a_khepera_iv_equal_plain_ones(driver: Driver, planar: bool) -> None:
    genes = GENES if isinstance(driver, Network) else None
    plain, compiled = (
        rollout("arena4", driver, range(2), 1.0, genes=genes, planar=planar, compiled=compiled)
        for compiled in (False, True)
    )
    assert (plain.registers == compiled.registers).all()
    assert (plain.poses == compiled.poses).all()
    assert (plain.registers[:, CHANNELS["ultrasonic"]] < 200).any()  # they are measured
    assert all((plain.metrics[name] == compiled.metrics[name])[0] for name in ("effort", "distance_m"))


def test_ground_sensors_of_the_plane_see_the_line_that_those_of_mujoco_see() -> None:
    for speed, seconds in ((0, 0.1), (200, 2.0)):  # MuJoCo's robot pitches while it accelerates
        mujoco, plane = (
            rollout("arena4-line", ConstantSpeed(speed, speed), [1], seconds, planar=planar, compiled=False)
            for planar in (False, True)
        )
        np.testing.assert_allclose(plane.registers[0, GROUND], mujoco.registers[0, GROUND], atol=15)
        np.testing.assert_allclose(plane.poses, mujoco.poses, atol=2e-3)
        assert mujoco.registers[0, GROUND].min() < (900 if speed else 100)


def test_inertial_sensors_of_the_plane_measure_what_those_of_mujoco_do() -> None:
    mujoco, plane = (
        rollout("arena4", ConstantSpeed(200, -200), [1], 1.0, planar=planar, compiled=False).registers[0]
        for planar in (False, True)
    )
    noise_counts = 300
    np.testing.assert_allclose(plane[INERTIAL], mujoco[INERTIAL], atol=noise_counts)
    assert plane[INERTIAL][-1] < -2000  # turns to the right


def test_robots_of_two_models_are_refused_in_one_episode() -> None:
    robots = "".join(
        f'[[robot]]\nmodel = "{model}"\nx_mm = {x}\ny_mm = 300\nheading_deg = 0\n'
        for model, x in (("khepera1", 200), ("khepera4", 600))
    )
    text = f'version = 1\nname = "both"\n[arena]\nwidth_mm = 800\nheight_mm = 600\n{robots}'
    with pytest.raises(PlaypenError, match="both: robots of 2 models; expected one model in an episode"):
        EpisodeSetup(parse(text, "both"))


def test_a_controller_of_another_model_is_refused() -> None:
    for driver, message in (
        (Braitenberg(), "Braitenberg: a robot of model khepera4; expected a Khepera"),
        (Network(genes=[0.0] * 18), "network of model 'khepera'; expected model = 'khepera4'"),
    ):
        with pytest.raises(ControllerError, match=message):
            rollout("arena4", driver, [0], 1.0, compiled=False)
    with pytest.raises(RobotModelError, match="model = 'kepler': unknown; did you mean 'khepera4'"):
        Network(model="kepler")


def test_a_networks_further_inputs_are_readings_within_their_limits() -> None:
    network = Network(terms=(*TERMS, "gyroscope"), model="khepera4", top_speed=1000)
    for reading in (0, 2, 6, 9):
        weights = np.zeros((1, network.n_genes))
        weights[0, 1 + 8 + reading] = 1.0
        before, after = (
            rollout("arena4", network, [1], seconds, genes=weights, compiled=False).registers[0]
            for seconds in (0.18, 0.2)
        )
        values = *before[CHANNELS["ultrasonic"]] / 250, *before[GROUND] / 1023, before[INERTIAL][-1] / 8000
        expected = 1000 * np.tanh(np.clip(values[reading], -1, 1))
        assert after[CHANNELS["speed"]][2] == pytest.approx(expected, abs=0.5)


def test_terms_that_a_model_lacks_are_refused() -> None:
    for driver, message in (
        (Function(avoid, terms=("grund",)), "model khepera4: term 'grund': unknown; did you mean 'ground'"),
        (Policy(policy, terms=("ground", "ground")), "a name is there twice; expected it once"),
    ):
        with pytest.raises(RobotModelError, match=message):
            rollout("arena4", driver, [0], 1.0, compiled=False)
    with pytest.raises(RobotModelError, match="model khepera1: term 'ground': unknown"):
        Network(terms=("ground",))


def test_a_line_of_a_khepera_iv_is_refused() -> None:
    with pytest.raises(PlaypenError, match="arena4: robot 1: model = 'khepera4'; expected a Khepera or"):
        rollout(
            "arena4", ConstantSpeed(10, 10), [0], 1.0, options=EpisodeOptions(line=115200), compiled=False
        )


def test_a_network_file_names_its_model(tmp_path: Path) -> None:
    network = NETWORK
    assert network.top_speed == 600
    genes = np.zeros(network.n_genes)
    network.save(tmp_path / "network.npz", genes, setup=EpisodeSetup(Playpen.load("arena4")))
    loaded = Network.load(tmp_path / "network.npz")
    assert (loaded.model, loaded.top_speed, loaded.sizes) == ("khepera4", 600, (26, 3, 2))
    assert (loaded.ambient, loaded.terms) == (True, (*TERMS, "gyroscope"))
    assert loaded.light == (980.0, 20.0)
    with np.load(tmp_path / "network.npz") as file:
        assert file["inputs"][[0, 18, 25]].tolist() == [
            "proximity back_left",
            "ultrasonic front",
            "gyroscope turn",
        ]
        assert [file["zero"][25], file["one"][25], file["one"][18]] == [0, 8000, 250]
        assert file["model"] == "khepera4"


def test_ambient_counts_that_rise_with_light_are_refused(tmp_path: Path) -> None:
    text = calibration.read("khepera4")[1].replace("[ambient]", "[ambient]\nrises_with_light = true")
    (tmp_path / "rising.toml").write_text(text)
    (robot,) = Playpen.load("arena4").robots
    playpen = Playpen.load("arena4").model_copy(
        update={"robots": (robot.model_copy(update={"calibration": str(tmp_path / "rising.toml")}),)}
    )
    with pytest.raises(PlaypenError, match="rises_with_light = true; expected false in an episode"):
        EpisodeSetup(playpen)
