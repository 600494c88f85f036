"""The BIOS tools and running modes."""

import pytest

from khep_twin import playpen
from khep_twin.board.kernel import AMBIENT, DEMO_SPEED_PULSES, LEFT, PROXIMITY, SETPOINTS
from khep_twin.board.protocol import Tool
from khep_twin.board.rom import ROMS
from khep_twin.board.turrets import find_turrets
from khep_twin.clock import NS_PER_S
from khep_twin.firmware import Firmware, parse
from khep_twin.host import Khepera
from khep_twin.playpen import Playpen
from khep_twin.world import World


def lines(reply: bytes) -> list[str]:
    assert reply.endswith(b"\r\n")
    return reply.decode("ascii").split("\r\n")[:-1]


@pytest.fixture
def firmware() -> Firmware:
    return Firmware(ROMS["5.02"])


@pytest.mark.parametrize(
    "tool", ["help", "help list", "help D", "list", "k-team", "net", "memory", "process"]
)
def test_a_tool_with_output_prints_it_in_lines(firmware: Firmware, tool: str) -> None:
    reply_lines = lines(firmware.receive(tool.encode() + b"\n"))
    assert reply_lines
    assert all(line.strip() for line in reply_lines)


def test_the_list_names_every_tool_and_command(firmware: Firmware) -> None:
    reply_lines = "\n".join(lines(firmware.receive(b"list\n")))
    for name in ("run", "serial", "help", "list", "k-team", "net", "memory", "process", "restart", "sfill"):
        assert f"TO  {name} " in reply_lines
        assert isinstance(parse(name.encode()), Tool)
    assert reply_lines.count("PR  ") == 18


@pytest.mark.parametrize(
    "tool", ["serial", "serial 12345", "serial x", "run", "run nothing", "sfill", "help x", "run sloader"]
)
def test_what_a_tool_cannot_do_is_refused(firmware: Firmware, tool: str) -> None:
    (line,) = lines(firmware.receive(tool.encode() + b"\n"))
    assert line.startswith("z,")


def test_serial_changes_the_speed_behind_its_reply_and_restart_changes_it_back() -> None:
    with Khepera("khep://default") as robot:
        start = robot.time
        assert robot.ask("serial 38400") == "serial 38400"
        slow = robot.time - start
        assert slow == pytest.approx((13 + 14) * 11 / 9600, rel=0.01)
        robot.port.baudrate = 38400
        start = robot.time
        robot.ask("H")
        assert robot.time - start == pytest.approx((2 + 7) * 11 / 38400, rel=0.01)
        start = robot.time
        robot.port.write(b"restart\n")
        robot.port.baudrate = 9600
        banner = b"".join(robot.port.readline() for _ in ROMS["5.02"].banner)
        assert robot.time - start == pytest.approx((8 / 38400 + len(banner) / 9600) * 11, rel=0.01)
        start = robot.time
        robot.ask("H")
        assert robot.time - start == pytest.approx((2 + 7) * 11 / 9600, rel=0.01)


def test_a_restart_leaves_every_sensor_in_its_place() -> None:
    text = playpen.dump(Playpen.load("two-lamps")).replace("y_mm = 200.0", "y_mm = 305.0")
    for wait_ns in range(0, 20_000_000, 2_500_000):
        world = World(playpen.parse(text, "scene"), noise=False)
        robot = world.robots[0]
        before = robot.registers[PROXIMITY + AMBIENT].tolist()
        assert before[2] > 0
        world.advance_to(wait_ns)
        robot.send(b"restart\n")
        world.advance_to(NS_PER_S)
        # It has settled on its wheels by some micrometres.
        assert robot.registers[PROXIMITY + AMBIENT].tolist() == pytest.approx(before, abs=1)


def test_mode_0_drives_by_itself_and_avoids_walls() -> None:
    text = playpen.dump(Playpen.load("default")).replace("mode = 1", "mode = 0")
    world = World(playpen.parse(text, "demo"), seed=1)
    ways = []
    for _ in range(30):
        world.advance_to(world.time_ns + NS_PER_S)
        ways.append(world.robots[0].pose[:2])
    assert len({(round(x, 2), round(y, 2)) for x, y in ways}) > 20
    assert min(min(x, y) for x, y in ways) > 0.03


def test_run_demo_starts_it_and_restart_ends_it(firmware: Firmware) -> None:
    assert lines(firmware.receive(b"run demo\n")) == ["run demo"]
    assert "demo" in lines(firmware.receive(b"process\n"))
    firmware.tick(0, 0)
    assert firmware.registers[SETPOINTS].tolist() == [DEMO_SPEED_PULSES] * 2
    firmware.receive(b"restart\n")
    firmware.tick(0, 0)
    assert firmware.registers[SETPOINTS].tolist() == [0, 0]
    assert firmware.register_view[LEFT] == 0


def test_mode_7_reports_a_self_test_at_a_reset() -> None:
    reply_lines = lines(Firmware(ROMS["5.02"], 7).receive(b"restart\n"))
    assert reply_lines[0].startswith("ROM of minirobot KHEPERA")
    assert "Self test" in reply_lines


@pytest.mark.parametrize(
    ("rom", "available"), [("5.02", [0, 1, 2, 3, 7]), ("khepera2", [0, 1, 2, 3, 7, 8, 9])]
)
def test_every_mode_is_there_or_refused_with_a_reason(rom: str, available: list[int]) -> None:
    assert sorted(ROMS[rom].modes) == list(range(16))
    assert [mode for mode in range(16) if not ROMS[rom].refusal_reason(mode)] == available


def test_a_refusal_says_why_and_what_is_right() -> None:
    assert ROMS["5.02"].refusal_reason(4).startswith("mode 4 runs a user's program")
    assert (
        ROMS["5.02"]
        .refusal_reason(9)
        .startswith("mode 9 is a mode of the Khepera II; the twin has it with rom")
    )
    assert ROMS["khepera2"].refusal_reason(14).startswith("mode E rewrites the robot's memory")
    assert (
        ROMS["khepera2"].refusal_reason(99).endswith("a running mode that the twin has (0, 1, 2, 3, 7, 8, 9)")
    )


@pytest.mark.parametrize(("mode", "baud"), [(1, 9600), (2, 19200), (3, 38400), (8, 57600), (9, 115200)])
def test_a_running_mode_sets_the_speed_of_the_line(mode: int, baud: int) -> None:
    assert Firmware(ROMS["khepera2"], mode).baud == baud


def test_net_lists_the_turrets() -> None:
    turrets = {kind: kind.make() for kind in find_turrets(["gripper"])}
    reply_lines = lines(Firmware(ROMS["5.02"], 1, turrets).receive(b"net\n"))
    assert reply_lines == ["1  gripper  arm with two fingers  revision 1.0"]
