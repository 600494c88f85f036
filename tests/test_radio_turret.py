"""Radios in a world: messages of hosts over their serial lines, and repeated runs."""

from pathlib import Path

import pytest
from radio_scene import playpen_with_radios

from khep_twin import playpen
from khep_twin.board.fault_injection import parse_fault
from khep_twin.board.radio import RadioPhase, RadioRegister
from khep_twin.errors import PlaypenError, PortTimeout, ProtocolError
from khep_twin.host import Khepera, Radio, RadioMessage, RadioStatus
from khep_twin.interventions import move_robot
from khep_twin.lab.experiment.multi_robot import run_together
from khep_twin.lab.experiment.repeat import repeat
from khep_twin.log.recorded import read_recorded_run
from khep_twin.ports.protocol_khep import Serial
from khep_twin.ports.twin import TwinOptions, open_twin
from khep_twin.world import World

MS = 1_000_000
TICK_MS = 10

PAIR = playpen_with_radios([(200, 250), (400, 250)])
LOSSY = playpen_with_radios([(200, 250), (400, 250), (600, 250)], "[radio]\nloss = 0.4\n")


def line(to: int, data: bytes) -> bytes:
    numbers = [to, len(data), *data, *[0] * (16 - len(data))]
    return f"T,4,S,{','.join(map(str, numbers))}\n".encode()


def radio_registers(world: World) -> list[list[int]]:
    return [turret.registers.tolist() for robot in world.robots for turret in robot.firmware.turrets.values()]


def register(world: World, robot: int, which: RadioRegister) -> int:
    return radio_registers(world)[robot][which]


def test_two_hosts_talk_to_each_other() -> None:
    def first(robot: Khepera) -> list[object]:
        radio = Radio(robot)
        assert radio.versions() == ("1", "0")
        radio.send(2, b"hello")
        return [radio.wait_until_sent(), radio.wait_for_message(), radio.receive(), radio.status()]

    def second(robot: Khepera) -> list[object]:
        radio = Radio(robot)
        message = radio.wait_for_message()
        radio.broadcast(bytes(range(240, 256)))
        return [message, radio.wait_until_sent(), radio.status()]

    outcomes = run_together(PAIR, [first, second], TwinOptions(seed=1))
    assert outcomes[0] == [True, RadioMessage(2, bytes(range(240, 256))), None, RadioStatus.READY]
    assert outcomes[1] == [RadioMessage(1, b"hello"), True, RadioStatus.READY]


def test_what_cannot_be_sent_is_an_error_of_the_host_library() -> None:
    slow = playpen_with_radios([(200, 250), (400, 250)], "[radio]\nair_time_ms = 500\n")
    with Khepera(Serial.of(open_twin(slow, TwinOptions()), timeout=1.0)) as robot:
        radio = Radio(robot)
        with pytest.raises(ValueError, match="a message of 17 bytes; expected at most 16"):
            radio.send(2, bytes(17))
        with pytest.raises(ProtocolError, match="Protocol error"):
            radio.send(256, b"")
        radio.send(2, b"")
        with pytest.raises(ProtocolError, match="Radio is sending"):
            radio.send(2, b"")
        with pytest.raises(PortTimeout, match="the radio still sends after 0 s"):
            radio.wait_until_sent(timeout=0)
        with pytest.raises(PortTimeout, match=r"no message came within 0\.1 s"):
            radio.wait_for_message(timeout=0.1)
        assert radio.wait_until_sent()
        radio.send(7, b"")
        assert not radio.wait_until_sent()


def test_a_robot_without_a_radio_is_an_error() -> None:
    with Khepera("khep://default") as robot, pytest.raises(ProtocolError, match="Turret order not supported"):
        Radio(robot)


def test_a_robot_that_drives_away_is_out_of_range() -> None:
    world = World(playpen_with_radios([(200, 250), (400, 250)], "[radio]\nrange_mm = 205\n"))
    messages = []
    for x in (0.400, 0.404, 0.406, 0.404):
        move_robot.place_robot(world, 1, x * 1000, 250, 0)
        world.robots[0].send(line(2, b"?"))
        world.advance_to(world.time_ns + 600 * MS)
        messages.append(register(world, 1, RadioRegister.RECEIVED))
    assert messages == [1, 2, 2, 3]


def test_a_message_takes_its_time_in_the_air() -> None:
    for air_time_ms in (10, 200):
        world = World(
            playpen_with_radios([(200, 250), (400, 250)], f"[radio]\nair_time_ms = {air_time_ms}\n"),
            unpaced=True,
        )
        world.advance_to(52 * MS)
        world.robots[0].send(line(2, b"?"))
        while not register(world, 1, RadioRegister.RECEIVED):
            world.advance_to(world.time_ns + TICK_MS // 2 * MS)
        assert 60 + air_time_ms <= world.time_ns / MS < 60 + air_time_ms + TICK_MS


def talk(world: World, until_ms: int) -> None:
    """Lets all robots send and read as the time of the world has it."""
    while world.time_ns < until_ms * MS:
        moment = world.time_ns // (20 * MS)
        robot = moment % len(world.robots)
        world.robots[robot].send(line((-1, 1, 2, 3)[moment % 4], moment.to_bytes(4, "little")))
        if moment % 5 == 0:
            world.robots[moment % 2].send(b"T,4,F\nT,4,R\n")
        world.advance_to(world.time_ns + 20 * MS)


@pytest.mark.share(2)
@pytest.mark.parametrize("compiled", [False, True])
def test_a_world_goes_on_bit_for_bit_from_a_snapshot_with_a_message_in_the_air(compiled: bool) -> None:
    world = World(LOSSY, seed=4, compiled=compiled)
    talk(world, 1000)
    snapshot = world.snapshot()
    phases = {register(world, robot, RadioRegister.PHASE) for robot in range(3)}
    assert RadioPhase.IN_AIR in phases
    talk(world, 3000)
    outcome = world.snapshot()
    assert sum(register(world, robot, RadioRegister.RECEIVED) for robot in range(3)) > 3
    other = World(LOSSY, seed=4, compiled=not compiled)
    for restored in (other, world):
        restored.restore(snapshot)
        talk(restored, 3000)
        assert restored.snapshot() == outcome


def test_another_seed_loses_other_messages() -> None:
    worlds = [World(LOSSY, seed=seed) for seed in (1, 1, 2)]
    for world in worlds:
        talk(world, 2000)
    registers = [radio_registers(world) for world in worlds]
    assert registers[0] == registers[1] != registers[2]


def test_a_log_of_three_robots_repeats(tmp_path: Path) -> None:
    def chatter(robot: Khepera) -> int:
        radio, n_received = Radio(robot), 0
        for number in range(8):
            radio.broadcast(bytes([number]))
            radio.wait_until_sent()
            n_received += radio.receive() is not None
        return n_received

    path = tmp_path / "run.mcap"
    received_counts = run_together(LOSSY, [chatter] * 3, TwinOptions(seed=2, log=str(path)))
    assert min(received_counts) > 0
    assert repeat(read_recorded_run(path)) is None


def test_a_restart_drops_a_message_in_the_air() -> None:
    world = World(PAIR)
    world.robots[0].send(line(2, b"?"))
    while register(world, 0, RadioRegister.PHASE) != RadioPhase.IN_AIR:
        world.advance_to(world.time_ns + 5 * MS)
    world.robots[0].send(b"restart\n")
    world.advance_to(world.time_ns + 500 * MS)
    assert register(world, 1, RadioRegister.RECEIVED) == 0
    assert register(world, 0, RadioRegister.PHASE) == RadioPhase.IDLE


def test_a_brown_out_at_the_receiver_drops_what_it_has_received() -> None:
    world = World(PAIR, faults=[parse_fault("brown-out@0.5")])
    world.robots[1].send(line(1, b"?"))
    world.advance_to(400 * MS)
    assert register(world, 0, RadioRegister.RECEIVED) == 1
    world.advance_to(600 * MS)
    assert register(world, 0, RadioRegister.RECEIVED) == 0


def test_a_robot_on_empty_cells_takes_no_message() -> None:
    text = PAIR.model_copy(
        update={
            "robots": (
                PAIR.robots[0],
                PAIR.robots[1].model_copy(update={"battery_used_min": 60.0}),
            )
        }
    )
    world = World(text)
    world.advance_to(100 * MS)
    assert not world.robots[1].firmware.powered
    world.robots[0].send(line(2, b"?"))
    world.advance_to(1000 * MS)
    assert register(world, 0, RadioRegister.HAS_FAILED) == 1


def test_the_tool_net_shows_the_turret() -> None:
    with Khepera(Serial.of(open_twin(PAIR, TwinOptions()), timeout=1.0)) as robot:
        robot.port.write(b"net\n")
        assert b"radio" in robot.port.read(400)


def test_a_playpen_names_what_is_wrong_in_its_radio_channel() -> None:
    with pytest.raises(PlaypenError, match=r"radio: loss = 2; expected a number from 0 to 1"):
        playpen_with_radios([(200, 250)], "[radio]\nloss = 2\n")


def test_the_channel_outlives_a_file() -> None:
    again = playpen.parse(playpen.dump(LOSSY), "again.toml")
    assert again == LOSSY
    assert again.radio.loss == 0.4
