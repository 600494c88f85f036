"""Episodes without a serial line: bitwise equal to a `World`, plain and compiled."""

import importlib.util
import sys
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numba_marks import KINDS, with_numba

from khep_twin import playpen, rollout
from khep_twin.board import kernel
from khep_twin.board.fault_injection import parse_fault
from khep_twin.board.kernel import AMBIENT, LEFT, PROXIMITY, SETPOINTS, Board, Wheel
from khep_twin.episodes import episode as episodes
from khep_twin.episodes.controllers import Braitenberg, ConstantSpeed, Function, Network
from khep_twin.episodes.episode import Episode
from khep_twin.episodes.episode_options import EpisodeOptions
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.errors import DivergedError, MissingNumbaError, PlaypenError
from khep_twin.playpen import Playpen
from khep_twin.sensing.seen_surfaces import N_COLUMNS
from khep_twin.units import COUNTS_LIMIT
from khep_twin.world import World

SHADOWS = """
[[lamp]]
x_mm = 620
y_mm = 80
power_w = 9
blink_period_s = 0.7
fade_s = 0.2
flicker = 0.4
"""


def arena(extra: str = "", **robot: object) -> Playpen:
    """Return the playpen "obstacles" with extra parts."""
    text = playpen.dump(Playpen.load("obstacles")) + extra
    scene = playpen.parse(text, "arena")
    return scene.model_copy(update={"robots": (scene.robots[0].model_copy(update=robot),)})


def braitenberg_world(scene: Playpen, seconds: float, **options: Any) -> World:
    """Return a world in which the Braitenberg vehicle sets its speeds every 20 ms without a delay."""
    world = World(scene, **options)
    register_view = world.robots[0].registers.data
    for period in range(round(seconds * 50)):
        if world.robots[0].firmware.powered:
            kernel.wander(register_view)
        world.advance_to((period + 1) * 20_000_000)
    return world


def episode_of(
    scene: Playpen, seconds: float, compiled: bool, driver: Any = None, seed: int = 0, **options: Any
) -> Episode:
    episode = Episode(EpisodeSetup(scene), driver or Braitenberg(), compiled=compiled)
    episode.begin(seed, EpisodeOptions(**options))
    episode.run(seconds)
    return episode


@pytest.mark.share(3)
@pytest.mark.parametrize("compiled", KINDS)
@pytest.mark.parametrize(
    ("scene", "options"),
    [
        pytest.param(arena(), {"seed": 1}, id="mixed surfaces"),
        pytest.param(arena(SHADOWS), {"seed": 2, "vary": True}, id="a lamp that blinks and fades"),
        pytest.param(arena(SHADOWS), {"noise": False}, id="without noise"),
        pytest.param(
            arena(model="khepera2", calibration="khepera2", rom="khepera2"), {"noise": 0.5}, id="khepera2"
        ),
        pytest.param(arena(battery_used_min=41.3), {"seed": 3}, id="cells that run out"),
        pytest.param(Playpen.load("two-lamps"), {"seed": 4}, id="two lamps"),
        pytest.param(Playpen.load("light-seeking"), {"seed": 5}, id="light seeking"),
    ],
)
def test_an_episode_equals_a_world_bitwise(scene: Playpen, options: dict[str, Any], compiled: bool) -> None:
    world, episode = braitenberg_world(scene, 4.0, **options), episode_of(scene, 4.0, compiled, **options)
    assert episode.registers.tolist() == world.robots[0].registers.tolist()
    assert episode.joints.tobytes() == world.data.qpos.tobytes()
    assert episode.pose == world.robots[0].pose


@pytest.mark.parametrize("planar", [False, True])
def test_the_noise_of_readings_is_in_proportion_to_its_scale(planar: bool) -> None:
    setup = EpisodeSetup(arena(), planar=planar)
    episode, readings = Episode(setup, ConstantSpeed(), compiled=False), dict[str, Any]()
    for noise in (0.0, False, 0.25, 0.5, 1.0, True):
        samples: list[list[int]] = []
        episode.begin(3, EpisodeOptions(noise=noise, start=(50.0, 300.0, 180.0)))
        for _ in range(20):
            episode.run(0.02)
            samples.append(
                [*episode.registers[AMBIENT].tolist(), *episode.registers[PROXIMITY][2:4].tolist()]
            )
        readings[f"{noise}"] = np.array(samples)
    np.testing.assert_array_equal(readings["True"], readings["1.0"])
    np.testing.assert_array_equal(readings["False"], readings["0.0"])
    half, quarter = (readings[scale] - readings["0.0"] for scale in ("0.5", "0.25"))
    assert half.std() > 3
    np.testing.assert_allclose(half, quarter * 2, atol=2)  # readings are rounded


@with_numba
@pytest.mark.parametrize("planar", [False, True])
def test_a_khepera_2_never_reads_0_without_a_line_plain_and_compiled(planar: bool) -> None:
    # A lamp that saturates the sensors leaves their lowest reading.
    lamp = "\n[[lamp]]\nx_mm = 100\ny_mm = 100\nz_mm = 100\npower_w = 100\n"
    setup = EpisodeSetup(arena(lamp, model="khepera2", calibration="khepera2"), planar=planar)
    lowest: list[list[int]] = []
    for compiled in (False, True):
        episode = Episode(setup, Braitenberg(), compiled=compiled)
        episode.begin(3)
        lowest.append([])
        for _ in range(100):
            episode.run(0.02)
            lowest[-1].append(min(episode.registers[PROXIMITY].tolist()))
    assert lowest[0] == lowest[1]
    assert min(lowest[0]) == 4


@pytest.mark.long
@with_numba
def test_compiled_and_plain_code_find_the_same_surfaces_to_the_last_bit() -> None:
    import numba

    from khep_twin.sensing import scene as queries
    from khep_twin.simulation.compiled import register
    from khep_twin.simulation.mujoco_calls import MujocoCalls

    register()

    @numba.njit(_nrt=False, error_model="numpy")
    def surfaces(scene: Any, robots: Any, channel: int, chip: Any, needed: float) -> int:
        return queries.surfaces(MujocoCalls(scene[0][0], scene[1]), robots[0].sensors, channel, chip, needed)

    cylinder = "[[cylinder]]\nx_mm = 300\ny_mm = 300\nradius_mm = 9\nheight_mm = 50\nmovable = true\n"
    world = World(arena(cylinder))
    plain, records = world.simulation.plain, world.simulation.robots.records[0]
    sensors, arrays = plain.groups[0][0].sensors, world._forms.compiled()
    columns = records["sensors"]["proximity"]["surfaces"][0]
    body = world.model.body("cylinder3").id
    world.robots[0].send(b"D,9,4\n")
    n_visible = n_overlapping = n_near_cylinder = 0
    for step in range(3000):
        world.advance_to((step + 1) * 2_500_000)
        channel = step % 8
        chip = plain.scene.chip(sensors, channel)
        count = queries.surfaces(plain.scene, sensors, channel, chip, 0.0)
        expected = sensors.proximity.surfaces[: count * N_COLUMNS]
        assert surfaces(arrays, records, channel, chip, 0.0) == count
        assert columns[: count * N_COLUMNS].tolist() == expected
        n_visible, n_overlapping = n_visible + (count > 0), n_overlapping + (count > 1)
        offset = world.data.xpos[body, :2] - (chip.x, chip.y)
        n_near_cylinder += count > 0 and bool(np.hypot(*offset) < chip.reach)
        if step % 100 == 0:
            # It stands in front of the robot, a little to one side, and leans.
            x, y, heading = world.robots[0].pose
            distance, lean = 0.05 + step * 5e-6, step * 2e-4
            address = world.model.jnt_qposadr[world.model.body_jntadr[body]]
            world.data.qpos[address : address + 3] = (
                x + distance * np.cos(heading),
                y + distance * np.sin(heading),
                0.03,
            )
            world.data.qpos[address + 3 : address + 7] = np.cos(lean / 2), np.sin(lean / 2), 0, 0
    assert 500 < n_visible < 2900
    assert n_overlapping > 300
    assert n_near_cylinder > 300


@pytest.mark.parametrize("compiled", KINDS)
def test_an_episode_does_not_depend_on_earlier_ones(compiled: bool) -> None:
    episode = Episode(EpisodeSetup(arena()), Braitenberg(), compiled=compiled)
    results: list[bytes] = []
    for seed in (1, 2, 1):
        episode.begin(seed, EpisodeOptions(start=(400.0, 290.0, 10.0 * seed)))
        episode.run(1.0)
        results.append(episode.registers.tobytes() + episode.joints.tobytes())
    assert results[0] == results[2] != results[1]


@with_numba
@pytest.mark.parametrize("step_ns", [5_000_000, 10_000_000])
def test_coarser_steps_convert_in_the_same_order_plain_and_compiled_alike(step_ns: int) -> None:
    # Plain code reads MuJoCo's rangefinders; compiled code casts rays at each conversion.
    episodes = [
        Episode(EpisodeSetup(arena(), step_ns=step_ns), Braitenberg(), compiled=compiled)
        for compiled in (False, True)
    ]
    sensors: set[int] = set()
    for episode in episodes:
        episode.begin(2, EpisodeOptions(start=(330.0, 300.0, 240.0)))
    for _ in range(150):
        for episode in episodes:
            episode.run(0.02)
        assert episodes[0].registers.tolist() == episodes[1].registers.tolist()
        sensors |= set(np.flatnonzero(episodes[0].registers[PROXIMITY] > 300).tolist())
    assert episodes[0].joints.tobytes() == episodes[1].joints.tobytes()
    assert len(sensors) >= 5


def test_coarser_steps_have_similar_trajectories() -> None:
    ends: list[tuple[float, float, float]] = []
    for step_ns in (2_500_000, 5_000_000, 10_000_000):
        episode = Episode(
            EpisodeSetup(Playpen.load("default"), step_ns=step_ns), ConstantSpeed(8, 6), compiled=False
        )
        episode.begin(options=EpisodeOptions(noise=False))
        episode.run(6.0)
        ends.append(episode.pose)
    for end, places, turned in zip(ends[1:], (0.002, 0.004), (0.011, 0.015), strict=True):
        assert end[:2] == pytest.approx(ends[0][:2], abs=places)
        assert end[2] == pytest.approx(ends[0][2], abs=turned)


def test_a_step_that_divides_no_tick_is_refused_with_the_choices() -> None:
    with pytest.raises(ValueError, match=r"3 ms .* 10 ms .* expected one of 2.5, 5, 10 ms"):
        EpisodeSetup(arena(), step_ns=3_000_000)


@pytest.mark.parametrize("compiled", KINDS)
def test_a_network_reads_registers_and_sets_speeds(compiled: bool) -> None:
    # Only biases: the outputs do not depend on the sensors.
    network = Network(top_speed=20)
    genes = np.zeros(network.n_genes)
    genes[0], genes[9] = np.arctanh(0.5), np.arctanh(-0.25)
    episode = episode_of(arena(), 0.2, compiled, network, genes=genes)
    assert episode.registers[SETPOINTS].tolist() == [10, -5]
    # Only one weight: left 90 drives the right wheel.
    genes[:] = 0
    genes[10] = 3.0
    episode = episode_of(arena(x_mm=44.0, y_mm=290.0, heading_deg=90.0), 0.2, compiled, network, genes=genes)
    proximity = episode.registers[PROXIMITY[0]] / COUNTS_LIMIT
    assert proximity > 0.1
    assert episode.registers[SETPOINTS[0]] == 0
    assert episode.registers[SETPOINTS[1]] == pytest.approx(20 * np.tanh(3 * proximity), abs=3)


def steer(proximity: Any, ambient: Any, memory: Any, genes: Any) -> tuple[float, float]:
    memory[0] += 1
    return genes[0] + memory[0], -200.0 + ambient[0] * 0 + proximity[0] * 0


@pytest.mark.share(2)
@pytest.mark.parametrize("compiled", KINDS)
def test_a_function_has_memory_and_genes_and_its_speeds_are_clipped_as_by_the_board(compiled: bool) -> None:
    episode = episode_of(arena(), 0.1, compiled, Function(steer, n_memory=1), genes=[2.5])
    assert episode.registers[SETPOINTS].tolist() == [round(2.5 + 5), -127]


@pytest.mark.share(2)
@pytest.mark.parametrize("compiled", KINDS)
def test_a_controller_whose_speed_is_not_finite_ends_its_episode(compiled: bool) -> None:
    episode = Episode(
        EpisodeSetup(arena()),
        Function(lambda proximity, ambient, memory, genes: (genes[0] / 0.5, 1.0)),
        compiled=compiled,
    )
    episode.begin(7, EpisodeOptions(genes=[1.0]))
    episode.run(0.02)
    episode.begin(7, EpisodeOptions(genes=[np.inf]))
    with pytest.raises(DivergedError, match=r"seed 7 failed at 0\.0000 s, step 0: .* no number"):
        episode.run(0.02)


@pytest.mark.parametrize("compiled", KINDS)
def test_physics_out_of_bounds_end_an_episode_and_do_not_affect_the_next(compiled: bool) -> None:
    episode = Episode(EpisodeSetup(arena()), Braitenberg(), compiled=compiled)
    episode.begin(1)
    episode.run(0.2)
    episode.data.qvel[0] = 1e9
    with pytest.raises(DivergedError, match=r"seed 1 failed at 0\.2\d+ s, step \d+: "):
        episode.run(0.2)
    episode.begin(1)
    episode.run(0.2)
    assert episode.steps == 80


@pytest.mark.parametrize("compiled", KINDS)
def test_episode_ends_its_homing_with_its_charge(compiled: bool) -> None:
    # Far from home, the charge of 0.1 s lasts five control periods; at home it is always full.
    def homing(home: tuple[float, float, float, float] | None) -> float:
        return episode_of(arena(), 0.4, compiled, ConstantSpeed(10, 10), noise=False, home=home).metrics()[
            "homing"
        ]

    assert homing((700.0, 500.0, 50.0, 0.1)) == pytest.approx(0.5 * 5 / 20, abs=0.02)
    assert homing((120.0, 290.0, 200.0, 0.1)) == 0
    assert np.isnan(homing(None))


@pytest.mark.parametrize("compiled", KINDS)
def test_the_distance_forwards_has_a_sign_and_the_distance_has_none(compiled: bool) -> None:
    def ways(left: int, right: int) -> tuple[float, float]:
        scene = Playpen.load("default")
        episode = episode_of(
            scene, 1.0, compiled, ConstantSpeed(left, right), noise=False, start=(300.0, 250.0, 130.0)
        )
        metrics = episode.metrics()
        return metrics["forward_m"], metrics["distance_m"]

    forwards, way = ways(5, 5)
    assert forwards == pytest.approx(way, rel=1e-6) == pytest.approx(0.04, rel=0.1)
    assert ways(-5, -5)[0] == pytest.approx(-forwards, rel=0.02)
    # Along an arc it is the length of the arc; in place it is zero.
    assert ways(4, 6)[0] == pytest.approx(ways(4, 6)[1], rel=1e-3)
    assert abs(ways(-5, 5)[0]) < 0.002


@pytest.mark.parametrize(("left", "right", "effort"), [(10, 10, 0.25), (-20, 0, 0.5), (40, 0, 0.5)])
def test_the_control_effort_is_the_mean_square_of_the_speeds(left: int, right: int, effort: float) -> None:
    episode = episode_of(Playpen.load("default"), 0.2, False, ConstantSpeed(left, right))
    assert episode.metrics()["effort"] == effort


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"robots": ()}, "0 robots; expected one"),
        ({"robots": arena().robots * 2}, "2 robots; expected one in the plane"),
    ],
)
def test_unsupported_playpens_are_refused_in_one_line(change: dict[str, Any], message: str) -> None:
    with pytest.raises(PlaypenError, match=message):
        EpisodeSetup(arena().model_copy(update=change), planar=True)
    with pytest.raises(PlaypenError, match=r"turrets = \['gripper'\]; expected none"):
        EpisodeSetup(Playpen.load("gripper"), planar=True)


def test_without_numba_episodes_run_uncompiled_with_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.warns(
        episodes.SlowerWarning, match=r"with the same results; .* -m pip install 'numba<1,>=0.61'$"
    ):
        episode = Episode(EpisodeSetup(arena()), Braitenberg())
    episode.begin()
    episode.run(0.02)
    assert episode.steps == 8


def test_compiled_without_numba_fails_with_the_command_to_install_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.delattr(rollout, "compiled", raising=False)
    monkeypatch.setitem(sys.modules, "khep_twin.episodes.compiled", None)
    with pytest.raises(MissingNumbaError, match=r"^numba is not installed; .* pip install 'numba<1,>=0.61'$"):
        Episode(EpisodeSetup(arena()), compiled=True)


def test_the_demo_of_the_rom_drives() -> None:
    episode = episode_of(arena(mode=0), 0.5, False, ConstantSpeed())
    assert episode.registers[LEFT + Wheel.POSITION] > 100
    assert episode.registers[Board.SCAN] == 0
    assert (episode.registers[AMBIENT] > 0).all()


def test_an_episode_that_was_not_started_raises_an_error() -> None:
    episode = Episode(EpisodeSetup(arena()), Braitenberg(), compiled=False)
    for action in (lambda: episode.run(0.02), episode.metrics, lambda: episode.drive(1, 1)):
        with pytest.raises(ValueError, match=r"no episode has begun; expected begin\(\) first"):
            action()


MORE_ROBOTS = """
[[robot]]
x_mm = 330
y_mm = 300
heading_deg = 90
[[robot]]
x_mm = 250
y_mm = 320
heading_deg = -20
"""


@pytest.mark.share(2)
@pytest.mark.parametrize("compiled", KINDS)
@pytest.mark.parametrize(
    ("scene", "faults"),
    [
        pytest.param(playpen.parse(playpen.dump(arena()) + MORE_ROBOTS, "three"), (), id="three robots"),
        pytest.param(Playpen.load("two-lamps"), (), id="lamps by turns"),
        pytest.param(Playpen.load("gripper"), (), id="a turret"),
        pytest.param(arena(), ("stuck:2@0.4", "dead:left@1.003", "brown-out@1.7"), id="faults"),
        pytest.param(arena(), ("dead:3", "slip:left:0.1@0.4-1", "blocked:right@1.2-1.5"), id="wheels"),
    ],
)
def test_robots_turrets_lamps_and_faults_equal_those_of_a_world(
    scene: Playpen, faults: tuple[str, ...], compiled: bool
) -> None:
    parsed_faults = tuple(map(parse_fault, faults))
    world = World(scene, seed=6, unpaced=True, faults=parsed_faults)
    episode = Episode(EpisodeSetup(scene, faults=parsed_faults), Braitenberg(), compiled=compiled)
    episode.begin(6)
    for period in range(120):
        for robot in world.robots:
            if robot.firmware.powered:
                kernel.wander(robot.registers.data)
        world.advance_to((period + 1) * 20_000_000)
    episode.run(2.4)
    assert episode.boards.tolist() == [robot.registers.tolist() for robot in world.robots]
    assert episode.joints.tobytes() == world.data.qpos.tobytes()
    assert episode.poses == world.poses
    assert len({tuple(episode.metrics(robot).items()) for robot in range(len(world.robots))}) == len(
        world.robots
    )


@with_numba
def test_a_switch_to_compiled_code_does_not_change_an_episode(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    network = Network(hidden=(3,), recurrent=True)
    genes = np.random.default_rng(4).normal(size=network.n_genes)
    plain = episode_of(arena(), 2.0, False, network, genes=genes, seed=3)
    monkeypatch.setattr(episodes, "_CHECK_INTERVAL", 200)
    results = iter([None, None])
    ready = episodes.when_ready
    monkeypatch.setattr(episodes, "when_ready", lambda part: next(results, ready(part)))
    episode = Episode(EpisodeSetup(arena()), network)
    episode.begin(3, EpisodeOptions(genes=genes))
    kinds: list[bool] = []
    for _ in range(20):
        episode.run(0.1)
        kinds.append(episode.world.simulation.is_compiled)
    assert kinds[0] is False
    assert kinds[-1] is True
    assert episode.registers.tolist() == plain.registers.tolist()
    assert episode.joints.tobytes() == plain.joints.tobytes()
    assert episode.metrics() == pytest.approx(plain.metrics(), nan_ok=True)


def test_a_start_is_needed_for_each_robot() -> None:
    setup = EpisodeSetup(playpen.parse(playpen.dump(arena()) + MORE_ROBOTS, "three"))
    with pytest.raises(ValueError, match=r"expected x, y .* of 3 robots"):
        Episode(setup, compiled=False).begin(options=EpisodeOptions(start=(300.0, 300.0, 0.0)))


def test_only_an_observed_episode_has_observers_and_shows_its_leds() -> None:
    setup = EpisodeSetup(arena())
    sample = SimpleNamespace(sample=lambda world: None)
    unobserved, observed = (Episode(setup, observed=observed, compiled=False) for observed in (False, True))
    for episode in (unobserved, observed):
        episode.begin(1)
        episode.registers[Board.LED_0] = 1
        episode.run(0.1)
    assert unobserved.world.model is setup.model
    assert observed.world.model.body_pos.tolist() != setup.model.body_pos.tolist()
    assert unobserved.joints.tobytes() == observed.joints.tobytes()
    observed.world.add_observer(sample)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="the world shares its model; expected one of its own"):
        unobserved.world.add_observer(sample)  # type: ignore[arg-type]
