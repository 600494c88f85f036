"""A robot of a stranger, the Toy of `toy_robot`: it works in all places that ask its model."""

import math
from hashlib import sha256
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from command_line import complaint, good
from matplotlib.patches import Circle
from numba_marks import with_numba

from khep_twin import ConstantSpeed, EpisodeSetup, Function, Network, rollout
from khep_twin import playpen as playpens
from khep_twin.board.fault_injection import parse_fault
from khep_twin.drawing.map import draw
from khep_twin.envs import TaskEpisode, TaskSetup
from khep_twin.episodes.planar.planar_world import PlanarWorld
from khep_twin.errors import CalibrationError, PortError, SnapshotError
from khep_twin.host import Khepera
from khep_twin.host.host_robot import open_robot
from khep_twin.host.opening import find_baud_rate
from khep_twin.playpen import Playpen
from khep_twin.ports.protocol_khep import Serial
from khep_twin.ports.twin import TwinOptions, open_twin
from khep_twin.robots.line_server import LineServer
from khep_twin.robots.registry import find_model
from khep_twin.sensing import calibration
from khep_twin.web import drafts
from khep_twin.web.robot_shape import robot_shape
from khep_twin.world import World

FOLDER = Path(__file__).parent / "toy_robot"

TEXT = """
version = 1
name = "toys"

[arena]
width_mm = 600
height_mm = 400

[[robot]]
model = "toy"
x_mm = 200
y_mm = 200
heading_deg = 0

[[robot]]
x_mm = 450
y_mm = 200
heading_deg = 180
"""

CONTROLLER = """
def wander(robot):
    nose = robot.read_panel()["proximity"][0]
    robot.set_speed(0.08, -0.08 if nose > 200 else 0.08)
    return {"nose": nose}
"""


pytestmark = pytest.mark.usefixtures("installed_toy")


@pytest.fixture
def toys() -> Playpen:
    """A Toy that faces a Khepera, 0.25 m away."""
    return playpens.parse(TEXT, "toys")


def frame(command: int, *values: int) -> bytes:
    """Return a frame of the Toy; 1 is its name, 2 sets the speeds, 3 reads the registers."""
    from toy_robot import model

    return model.frame(command, *values)


def drive(world: World, left: int = 100, right: int = 50) -> list[str]:
    """Drive the Toys of a world; return hashes of their registers and of the physics."""
    digests: list[str] = []
    for _ in range(4):
        for robot in world.robots:
            if isinstance(robot.firmware, LineServer):
                robot.send(frame(2, left, right))
        world.advance(0.1331)
        contents = [robot.registers.tobytes() for robot in world.robots]
        digests.append(sha256(b"".join([*contents, world.data.qpos.tobytes()])).hexdigest())
    return digests


def test_a_playpen_has_a_toy_with_the_defaults_of_its_model(toys: Playpen, tmp_path: Path) -> None:
    robot = toys.robots[0]
    assert (robot.model, robot.rom, Path(robot.calibration).name) == ("toy", "toy-1", "toy.toml")
    named = TEXT.replace('"toy"', '"toy"\ncalibration = "toy"', 1)
    assert playpens.parse(named, "toys") == toys == playpens.parse(text := playpens.dump(toys), "toys")
    # The path differs by machine.
    assert 'calibration = "toy"\n' in text
    assert calibration.read("toy") == calibration.read(robot.calibration)
    with pytest.raises(CalibrationError, match=r"toi: no such file; .* did you mean 'toy'"):
        calibration.read("toi")
    (tmp_path / "toys.toml").write_text(TEXT)
    assert good("playpen", "check", "toys.toml", folder=tmp_path) == "toys: 2 robots: no problem\n"
    (tmp_path / "toys.toml").write_text(TEXT.replace('"toy"', '"toy"\ncalibration = "khepera1"'))
    assert complaint("playpen", "check", "toys.toml", folder=tmp_path).endswith(
        'khepera1: of another robot than model = "toy"; expected a calibration with 5 sensors around and no '
        "sensors of the ground"
    )
    for key, expected in (("mode = 2", "mode = 2"), ('rom = "5.02"', "toy-1"), ('turrets = ["gripper"]', "")):
        (tmp_path / "toys.toml").write_text(TEXT.replace('"toy"', f'"toy"\n{key}'))
        line = complaint("playpen", "check", "toys.toml", folder=tmp_path)
        assert "robot 1" in line
        assert "toy" in line
        assert expected in line


def test_a_toy_drives_and_its_sensors_see_what_is_there(toys: Playpen) -> None:
    world = World(toys, noise=False)
    robot = world.robots[0]
    robot.send(frame(2, 100, 100))
    world.advance(1)
    readings = robot.readings()
    x, y, heading = robot.pose
    assert x == pytest.approx(0.2 + readings["position"][0] * toys.robots[0].body.pulse_length, abs=0.003)
    assert readings["speed"] == [pytest.approx(100, abs=8)] * 2 + [100, 100]
    ray = heading + math.radians(20)
    eye_x = x + 0.031 * math.cos(ray)
    assert readings["ultrasonic"] == [pytest.approx(1000 * (0.6 - eye_x) / math.cos(ray), abs=5)]
    world.advance(0.9)
    assert y == pytest.approx(0.2, abs=0.002)
    nose, left_cheek, _, ear, tail = robot.readings()["proximity"]
    assert nose > 300
    assert nose > left_cheek
    assert ear < 20
    assert tail < 20


def test_a_restored_toy_continues_to_the_last_bit(toys: Playpen) -> None:
    world = World(toys, seed=3)
    drive(world)
    snapshot = world.snapshot()
    digests = drive(world, -50, 0)
    copy = World(toys, seed=9)
    copy.restore(snapshot)
    assert drive(copy, -50, 0) == digests
    with pytest.raises(SnapshotError):
        World("obstacles").restore(snapshot)
    state = world.state()
    damaged = state.robots[0]._replace(arrays={"registers": np.full(17, 2**20).tobytes()})
    with pytest.raises(SnapshotError, match="register = 1048576; expected -32768 to"):
        world.set_state(state._replace(robots=(damaged, *state.robots[1:])))


def test_a_toy_and_a_khepera_share_a_world_and_toys_vary(toys: Playpen) -> None:
    world = World(toys, seed=3)
    assert world.simulation.robots.models == ("khepera", "toy")
    drive(world)
    reverse = World(toys.model_copy(update={"robots": toys.robots[::-1]}), seed=3)
    assert reverse.simulation.robots.models == ("khepera", "toy")
    assert [robot.name for robot in world.robots] == ["khepera0", "khepera1"]
    assert world.robots[1].registers.shape != world.robots[0].registers.shape
    varied = World(toys, seed=3, vary=True)
    assert drive(varied) != drive(World(toys, seed=3))


@pytest.mark.long
@with_numba
def test_a_toy_with_faults_runs_compiled_as_plain(toys: Playpen) -> None:
    one = toys.model_copy(update={"robots": toys.robots[:1]})
    texts = (
        "dead:proximity_nose@0.1",
        "stuck:5@0.2-0.4",
        "weak:left:0.5@0.1",
        "slip:right:0.2",
        "blocked:left@0.3",
    )
    faults = [parse_fault(text) for text in texts]
    plain, compiled = (drive(World(one, seed=5, compiled=way, faults=faults)) for way in (False, True))
    assert compiled == plain


def test_the_host_class_of_a_toy_drives_a_twin_in_this_process(toys: Playpen) -> None:
    with open_robot(find_model("toy"), Serial.of(open_twin(toys), 1.0)) as robot:
        toy = cast(Any, robot)
        toy.set_speed(0.1, 0.1)
        toy.sleep(1)
        channels = toy.read_channels("position", "ultrasonic", "proximity")
        pulse = find_model("toy").body.pulse_length
        assert np.array(channels["position"]) * pulse == pytest.approx(0.095, abs=0.01)
        assert channels["ultrasonic"] == [pytest.approx(290, abs=20)]
        assert len(channels["proximity"]) == 5
    with pytest.raises(PortError, match="the robot is a Toy"):
        Khepera(Serial.of(open_twin(toys), 1.0))


def test_the_baud_rate_of_a_toy_is_found(toys: Playpen) -> None:
    twin = open_twin(toys, TwinOptions(strict_line=True))
    port: Any = Serial.of(twin, 1.0)
    assert find_baud_rate(port, "toy", lambda: twin.world.time_ns / 1e9)[0] == port.baudrate == 57_600


def test_a_toy_is_served(served: Any, toys: Playpen) -> None:
    with served(toys) as url, open_robot(find_model("toy"), url) as robot:
        robot.check_model()
        assert robot.ask("c501 3a") == "C501546F7901FD"
        cast(Any, robot).set_speed(0.05, 0.05)


@pytest.fixture(scope="module")
def log(installed_toy: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Log of a Toy that drives for 2 s."""
    path = tmp_path_factory.mktemp("logs") / "toy.mcap"
    twin = open_twin(playpens.parse(TEXT, "toys"), TwinOptions(log=path))
    with open_robot(find_model("toy"), Serial.of(twin, 1.0)) as robot:
        cast(Any, robot).set_speed(0.08, 0.1)
        for _ in range(20):
            cast(Any, robot).read_panel()
            robot.sleep(0.1)
    return path


def test_a_log_of_a_toy_has_its_columns(log: Path, tmp_path: Path) -> None:
    good("export", log, "-o", tmp_path / "both.csv")
    header = (tmp_path / "both.csv").read_text().splitlines()[0].split(",")
    assert {"proximity_left_90", "toy_proximity_nose", "ultrasonic_beacon"} <= {*header}
    good("export", log, "-o", tmp_path / "toy.csv", "--robot", "khepera0")
    header = (tmp_path / "toy.csv").read_text().splitlines()[0].split(",")
    assert {"proximity_nose", "ultrasonic_beacon", "speed_setpoint_left", "position_right"} <= {*header}


def test_a_log_of_a_toy_is_repeated_reported_and_shown(log: Path, tmp_path: Path) -> None:
    assert good("repeat", log).startswith("identical: ")
    good("report", log, "-o", tmp_path / "report.html")
    page = (tmp_path / "report.html").read_text()
    assert ", of a Toy 150" in page
    assert "Distance by counters" in page
    good("view", log, "--save", tmp_path / "view.rrd")


def test_a_beam_in_the_viewer_is_as_long_as_the_reading_in_millimetres() -> None:
    pytest.importorskip("rerun")
    from khep_twin.log.viewer.further_sensors import arena_chunks

    samples: Any = SimpleNamespace(
        times_ns=np.zeros(1, np.int64), extra_channels={"ultrasonic": np.full((1, 1), 300.0)}
    )
    model = find_model("toy")
    batches = [
        chunk.to_record_batch() for chunk in arena_chunks("khepera0", model, samples, np.zeros((0, 3)))
    ]
    (strips,) = (batch["LineStrips3D:strips"].to_pylist() for batch in batches if "Line" in str(batch.schema))
    assert model.body.sonar is not None
    ends = np.hypot(*np.array(strips[0][0])[:, :2].T)
    assert ends.max() == pytest.approx(0.3 + model.body.sonar.radius, abs=1e-3)


def test_the_map_shows_a_toy_by_its_size(toys: Playpen) -> None:
    figure = draw(toys)
    circles = [patch for patch in figure.axes[0].patches if isinstance(patch, Circle)]
    assert [circle.radius for circle in circles] == pytest.approx([45, 27.5])


def test_a_twin_of_a_toy_conforms_to_its_checks(toys: Playpen, tmp_path: Path) -> None:
    (tmp_path / "toys.toml").write_text(TEXT)
    text = good("conform", "khep://toys.toml", "--model", "toy", "--move", folder=tmp_path)
    assert "2 passed, 0 failed" in text


def test_the_page_lists_the_model_and_draws_its_shape(toys: Playpen) -> None:
    choices: Any = drafts.models()["toy"]
    assert choices["modes"] == {"toy-1": {1: "57600 baud"}}
    assert (choices["defaults"]["calibration"], choices["calibrations"]) == ("toy", ["toy"])
    shape = robot_shape(find_model("toy"), toys.robots[0].calibration)
    assert shape["sensors"][0] == [44.0, 5.0, 5]
    assert len(shape["sonar"]) == 1
    assert drafts.problems_of(drafts.draft_of(toys)) == []


def test_a_controller_in_python_drives_a_toy(tmp_path: Path) -> None:
    (tmp_path / "toys.toml").write_text(TEXT)
    (tmp_path / "wander.py").write_text(CONTROLLER)
    words = "run", "wander.py", "--playpen", "toys.toml", "--seconds", "2", "--log", "run.mcap"
    text = good(*words, folder=tmp_path)
    assert text.startswith("210 cycles in 2.0 s\nfitness ")
    assert "speed mean          0.7979 pulses/10 ms" in text
    assert complaint("run", "braitenberg", "--playpen", "toys.toml", folder=tmp_path) == (
        "braitenberg: model = 'toy' has no vehicle; expected a Khepera or Khepera II or "
        "Khepera III or Khepera III with firmware 2 or Khepera IV"
    )
    network = Network(model="toy")
    network.save(tmp_path / "best.npz", [0.3] * network.n_genes)
    words = "run", "best.npz", "--playpen", "toys.toml", "--seconds", "1"
    assert good(*words, folder=tmp_path).startswith("50 cycles in 1.0 s\nfitness ")
    assert complaint("run", "best.npz", "--seconds", "1", folder=tmp_path) == (
        "best.npz: model = 'toy'; expected 'khepera' for a Khepera"
    )


def away(proximity, ambient, memory, genes):
    return (60.0, -60.0) if max(proximity) > 200 else (100.0, 100.0)


@pytest.mark.filterwarnings("ignore:.*overflow encountered in scalar multiply:RuntimeWarning")
def test_toys_run_in_rollouts_alike_plain_compiled_and_on_a_simulated_gpu(toys: Playpen) -> None:
    one = toys.model_copy(update={"robots": toys.robots[:1]})
    network = Network(hidden=(3,), model="toy")
    assert (network.sizes, network.top_speed) == ((5, 3, 2), 200)
    genes = np.random.default_rng(1).normal(size=(2, network.n_genes))
    for driver, options in ((Function(away), {}), (network, {"genes": genes})):
        for planar in (False, True):
            plain = rollout(one, driver, [1, 2], 1.0, planar=planar, compiled=False, **options)
            assert plain.metrics["distance_m"].max() > 0.01
            if planar and find_spec("numba"):
                compiled = rollout(one, driver, [1, 2], 1.0, planar=planar, compiled=True, **options)
                assert (plain.registers == compiled.registers).all()
                assert (plain.poses == compiled.poses).all()
    if find_spec("numba_cuda"):  # simulated, as `conftest` sets
        on_card = rollout(one, network, [1, 2], 0.2, planar=True, device="cuda", genes=genes)
        plain = rollout(one, network, [1, 2], 0.2, planar=True, compiled=False, genes=genes)
        assert (plain.registers == on_card.registers).all()
        assert (plain.poses == on_card.poses).all()


def test_voltages_are_clipped_in_the_plane_as_in_mujoco(toys: Playpen) -> None:
    one = toys.model_copy(update={"robots": toys.robots[:1]})
    mujoco, plane = (
        rollout(one, ConstantSpeed(500, 500), [1], 0.3, planar=planar, compiled=False)
        for planar in (False, True)
    )
    assert plane.metrics["distance_m"] == pytest.approx(mujoco.metrics["distance_m"], rel=0.05)
    setup = EpisodeSetup(one, planar=True)
    world = PlanarWorld(setup.scene_model, cast(Any, setup.planar_scene))
    world.simulation.plain.scene.set_motor(0, -40.0)
    assert world.forms.state["ctrl"].tolist() == [-6, 0]


def test_toys_run_in_environments_with_a_term_of_their_own(toys: Playpen) -> None:
    pytest.importorskip("gymnasium")
    from khep_twin.envs import Task, make_vec
    from khep_twin.envs.tasks import avoiding

    one = toys.model_copy(update={"robots": toys.robots[:1]})
    vector = make_vec("khep_twin/ObstacleAvoidance-v0", 2, playpen=one, planar=True, seconds=1)
    observations, _ = vector.reset(seed=1)
    assert observations.shape == (2, 7)
    assert vector.unwrapped.labels[:2] == ("proximity nose", "proximity left_cheek")
    for _ in range(10):
        observations, rewards, *_ = vector.step(np.full((2, 2), 0.5, np.float32))
    np.testing.assert_allclose(observations[:, 5:], 0.5, atol=0.05)
    assert (rewards > 0.2).all()
    task = Task("Ranging", "obstacles", ("ultrasonic", "speed"), avoiding, model="toy")
    episode = TaskEpisode(TaskSetup(task, playpen=one, start=(200, 200, -20), compiled=False))
    (observation,) = episode.begin(1)
    assert -0.7 < observation[0] < -0.3  # 0.37 m of 1.5 m
