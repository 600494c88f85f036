"""Cores of the models: a world has those of its robots alone, and runs plain and compiled alike."""

import hashlib
from itertools import pairwise

import pytest
from numba_marks import with_numba

from khep_twin.playpen import Lamp, Playpen
from khep_twin.robots.core import CORES, DUTIES, core_of
from khep_twin.robots.khepera4.registers import Control, DspicRegister
from khep_twin.robots.khepera4.robot import Khepera4Robot
from khep_twin.robots.registry import find_family, installed_families
from khep_twin.simulation.ready import function_of, part_of
from khep_twin.world import World

SPEEDS = ((300, -200), (-150, 500), (400, 420), (0, 0))
LAMPS = tuple(Lamp(x_mm=200 + 60 * number, y_mm=1700, power_w=3) for number in range(24))


def drive(world: World) -> list[str]:
    """Drive the Kheperas IV of a world by all kinds of control; return hashes of registers and physics."""
    robots = [robot for robot in world.robots if isinstance(robot, Khepera4Robot)]
    digests: list[str] = []
    for control in (*Control, *Control):
        for robot in robots:
            for speeds in SPEEDS[control % 4 :]:
                orders = b"".join(speed.to_bytes(2, "little", signed=True) for speed in speeds)
                robot.dspic.write(bytes([DspicRegister.SPEED_ORDER_LEFT]) + orders)
                robot.dspic.write(bytes([DspicRegister.PWM_ORDER_LEFT]) + orders)
            robot.dspic.write(bytes([DspicRegister.POSITION_ORDER_LEFT, *bytes([0, 9, 0, 0, 0, 7, 0, 0])]))
            robot.dspic.write(bytes([DspicRegister.CONTROL, control]))
        world.advance(0.1331)
        contents = [robot.dspic.read(0, 270) for robot in robots]
        digests.append(hashlib.sha256(b"".join([*contents, world.data.qpos.tobytes()])).hexdigest())
    return digests


def test_each_core_gives_a_function_for_each_duty() -> None:
    for name, model in installed_families().items():
        core = core_of(model)
        assert core.name == name
        assert CORES[core.state] is core
        assert {"pose", "radius", "noise"} <= {*core.state._fields}
        assert {*core.changing} <= {*core.state._fields}
        assert all(callable(getattr(core, duty.__name__)) for duty in DUTIES)


@pytest.mark.parametrize(
    ("playpen", "models"),
    [("obstacles", ("khepera",)), ("arena4", ("khepera4",)), ("arena4-two", ("khepera", "khepera4"))],
)
def test_a_world_has_a_group_for_each_model(playpen: str, models: tuple[str, ...]) -> None:
    simulation = World(playpen).simulation
    assert simulation.robots.models == models
    for model, group in zip(models, simulation.plain.groups, strict=True):
        assert all(type(robot) is core_of(find_family(model)).state for robot in group)
    for index, entry in enumerate(Playpen.load(playpen).robots):
        assert type(simulation.robots.state_of(index)) is core_of(entry.robot_model).state


@with_numba
def test_a_world_compiles_the_modules_of_its_models_and_nothing_else() -> None:
    from khep_twin.simulation.compiled import sources_of

    sources = {models: {module.__name__ for module in sources_of(*models)} for models in (("khepera",), ())}
    assert sources["khepera",] - sources[()] == {*core_of(find_family("khepera")).modules}
    assert not any("khepera4" in name for name in sources["khepera",])
    parts = [part_of("world", models) for models in (["khepera"], ["khepera4"], ["khepera", "khepera4"])]
    assert parts == ["world", "world.khepera4", "world.khepera.khepera4"]
    names = [function_of(part).py_func.__qualname__ for part in parts]
    assert all(one != other for one, other in pairwise(names))


@with_numba
@pytest.mark.parametrize("playpen", ["arena4", pytest.param("arena4-two", marks=pytest.mark.long)])
def test_a_khepera_iv_runs_compiled_as_plain_to_the_last_bit(playpen: str) -> None:
    plain, compiled = (drive(World(playpen, seed=5, compiled=compiled)) for compiled in (False, True))
    assert compiled == plain


@with_numba
@pytest.mark.parametrize("compiled", [False, True])
def test_a_reading_belongs_to_the_lamps_of_its_measurement(compiled: bool) -> None:
    lit, early = World("arena4", noise=False, compiled=compiled), World("arena4", noise=False)
    ambient: list[list[int]] = []
    for world in (lit, early):
        world.set_lamps(LAMPS[:2])
        world.advance(0.1)
        robot = world.robots[0]
        assert isinstance(robot, Khepera4Robot)
        if world is lit:  # more lamps than the moments had space for
            world.set_lamps(LAMPS)
        ambient.append(robot.readings()["ambient"])
        world.advance(0.01)
        ambient.append(robot.readings()["ambient"])
    assert ambient[0] == ambient[2] == ambient[3]
    assert ambient[1] != ambient[0]


@with_numba
@pytest.mark.parametrize("compiled", [False, True])
def test_a_battery_stops_the_robot_and_its_program_at_the_same_control_period(compiled: bool) -> None:
    pen = Playpen.load("arena4")
    robot = pen.robots[0].model_copy(update={"battery_used_min": 299.9995})
    world = World(pen.model_copy(update={"robots": (robot,)}), noise=False, compiled=compiled)
    events: list[tuple[int, str]] = []

    class Events:
        def on_event(self, time_ns: int, robot: int | None, text: str) -> None:
            events.append((time_ns, text))

        def __getattr__(self, name: str) -> object:
            return lambda *arguments: None

    world.add_observer(Events())  # pyright: ignore[reportArgumentType]
    world.robots[0].send(b"A,1\r\n")
    world.advance(0.5)
    assert [text for _, text in events] == ["the battery is empty: the robot stands still"]
    assert events[0][0] == 60_000_000
    assert not world.data.ctrl.any()
