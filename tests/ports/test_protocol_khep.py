"""khep://: the behaviour of pyserial in simulated time."""

from pathlib import Path

import pytest
import serial
from served_twin import ask

import khep_twin  # noqa: F401  (teaches pyserial khep://)
from khep_twin.errors import KhepTwinError
from khep_twin.ports.protocol_khep import TwinPortError, parse_url
from khep_twin.ports.twin import TwinOptions

BYTE_NS = 11 * 10**9 // 9600


def connect(
    url: str = "khep://default?noise=off", timeout: float | None = 1.0, baudrate: int = 9600
) -> serial.SerialBase:
    return serial.serial_for_url(url, baudrate=baudrate, stopbits=2, timeout=timeout)


def test_a_command_is_answered_after_its_time_on_the_line() -> None:
    with connect() as port:
        assert port.write(b"B\n") == 2
        assert port.readline() == b"b,5.02,5.01\r\n"
        # 2 bytes there, 13 bytes back; each burst is rounded once.
        assert port.time_ns == 2 * 11 * 10**9 // 9600 + 13 * 11 * 10**9 // 9600


def test_the_mode_sets_the_speed_of_the_robots_line() -> None:
    with connect("khep://default?mode=3", baudrate=38400) as port:
        ask(port, b"B\n")
        assert port.time_ns == 2 * 11 * 10**9 // 38400 + 13 * 11 * 10**9 // 38400


@pytest.mark.parametrize("ending", [b"\n", b"\r", b"\r\n"])
def test_every_way_of_reading_gives_the_same_bytes(ending: bytes) -> None:
    def by_line(port: serial.SerialBase) -> bytes:
        return port.readline()

    def by_byte(port: serial.SerialBase) -> bytes:
        return b"".join(port.read(1) for _ in range(13))

    def at_once(port: serial.SerialBase) -> bytes:
        return port.read(13)

    def by_polling(port: serial.SerialBase) -> bytes:
        data = b""
        while not data.endswith(b"\n"):
            data += port.read(port.in_waiting)
        return data

    def without_blocking(port: serial.SerialBase) -> bytes:
        port.timeout = 0
        data = b""
        while not data.endswith(b"\n"):
            data += port.read(100)
        return data

    for way in (by_line, by_byte, at_once, by_polling, without_blocking):
        with connect() as port:
            port.write(b"B" + ending)
            assert way(port) == b"b,5.02,5.01\r\n", way.__name__


def test_a_read_that_gets_nothing_costs_its_timeout() -> None:
    with connect(timeout=0.5) as port:
        assert port.read(5) == b""
        assert port.time_ns == 500_000_000
        assert port.readline() == b""
        assert port.time_ns == 1_000_000_000


def test_a_timeout_ends_in_the_middle_of_a_reply_and_loses_nothing() -> None:
    with connect(timeout=0.005) as port:
        first = ask(port, b"B\n")
        assert first == b"b,"[: len(first)]
        assert len(first) < 13
        port.timeout = 1
        assert first + port.readline() == b"b,5.02,5.01\r\n"


def test_a_poll_costs_one_byte_time() -> None:
    with connect(timeout=0) as port:
        assert port.in_waiting == 0
        assert port.time_ns == BYTE_NS
        assert port.read(1) == b""
        assert port.time_ns == 2 * BYTE_NS


def test_a_read_that_could_never_end_is_an_error() -> None:
    with connect(timeout=None) as port:
        with pytest.raises(serial.SerialException, match="waiting for ever"):
            port.read(1)
        assert ask(port, b"B\n") == b"b,5.02,5.01\r\n"


def test_time_passes_only_in_waiting() -> None:
    with connect() as port:
        port.write(b"D,5,5\n")
        assert port.time_ns == 0
        assert port.out_waiting == 6
        port.flush()
        assert port.time_ns == 6 * 11 * 10**9 // 9600
        port.sleep(0.25)
        assert port.time_ns == 6 * 11 * 10**9 // 9600 + 250_000_000
        assert port.in_waiting == 3


def test_buffers_are_reset() -> None:
    with connect() as port:
        port.write(b"B\nB\n")
        port.sleep(0.1)
        port.reset_input_buffer()
        port.write(b"xyz")
        port.reset_output_buffer()
        assert ask(port, b"E\n") == b"e,0,0\r\n"


def test_a_host_that_writes_more_than_the_line_holds_is_made_to_wait() -> None:
    with connect() as port:
        port.write(b"E\n" * 2000)
        assert port.out_waiting <= 1024
        assert port.time_ns > 2900 * BYTE_NS
        replies = [port.readline() for _ in range(2000)]
        assert set(replies) == {b"e,0,0\r\n"}


def test_reading_nothing_costs_nothing() -> None:
    with connect() as port:
        assert port.read(0) == b""
        assert port.time_ns == 0


def test_a_look_that_finds_something_costs_nothing() -> None:
    with connect() as port:
        port.write(b"B\n")
        port.sleep(0.1)
        port.timeout, before = 0, port.time_ns
        assert port.read(100) == b"b,5.02,5.01\r\n"
        assert port.time_ns == before


def test_while_replies_wait_no_more_commands_are_taken() -> None:
    with connect() as port:
        port.write(b"N\n" * 400)
        port.sleep(0.8)
        tx = port.twin.robot.uart.tx
        assert len(tx) - tx.count_arrived(port.time_ns) <= 256 + 45
        replies = [port.readline() for _ in range(400)]
        assert all(reply.count(b",") == 8 for reply in replies)


def test_what_is_taken_back_leaves_the_line_free() -> None:
    with connect() as port:
        port.write(b"x" * 1000)
        port.reset_output_buffer()
        start = port.time_ns
        ask(port, b"\nB\n")
        assert port.time_ns - start < 40_000_000


def test_a_write_that_finds_no_room_ends_with_its_timeout() -> None:
    with connect() as port:
        port.write_timeout = 0.1
        with pytest.raises(serial.SerialTimeoutException):
            port.write(b"N\n" * 1000)
        assert port.time_ns == 100_000_000
        port.write_timeout = 0
        assert port.write(b"N\n" * 1000) < 2000
        assert port.time_ns == 100_000_000


def test_another_speed_of_the_host_is_felt_and_reported_once() -> None:
    with connect() as port:
        port.baudrate = 38400
        with pytest.warns(UserWarning, match="at 38400 baud.* still accepted; .*mode=3"):
            port.write(b"B\n")
        assert port.readline() == b"b,5.02,5.01\r\n"
        # The host's bytes cross at the host's speed, the robot's at the robot's.
        assert port.time_ns == 2 * 11 * 10**9 // 38400 + 13 * 11 * 10**9 // 9600
        port.write(b"B\n")


def test_on_a_strict_line_another_speed_makes_noise_both_ways() -> None:
    with connect("khep://default?strict_line=on&seed=3", timeout=0.2) as port:
        port.baudrate = 19200
        with pytest.warns(UserWarning, match="the bytes are garbled"):
            port.write(b"B\n" * 20)
        assert b"5.02" not in port.read(300)
        port.baudrate = 9600
        port.write(b"\n")
        port.read(300)
        assert ask(port, b"B\n") == b"b,5.02,5.01\r\n"


def test_after_the_tool_serial_the_host_changes_its_speed() -> None:
    with connect("khep://default?strict_line=on") as port:
        assert ask(port, b"serial 38400\n") == b"serial 38400\r\n"
        port.baudrate = 38400
        start_ns = port.time_ns
        assert ask(port, b"B\n") == b"b,5.02,5.01\r\n"
        assert port.time_ns - start_ns == 2 * 11 * 10**9 // 38400 + 13 * 11 * 10**9 // 38400


def test_the_ports_of_pyserial_are_all_there() -> None:
    with connect() as port:
        port.dtr, port.rts, port.break_condition = True, False, False
        assert (port.cts, port.dsr, port.ri, port.cd) == (True, True, False, True)
        port.baudrate = 38400
        port.timeout = None
        port.write_timeout = 1
    assert not port.is_open
    for use in (lambda: port.read(1), lambda: port.write(b"x"), lambda: port.in_waiting):
        with pytest.raises(serial.PortNotOpenError):
            use()
    port.close()


def test_several_twins_live_side_by_side() -> None:
    with connect("khep://default?seed=1") as one, connect("khep://obstacles?seed=1") as other:
        one.sleep(1)
        assert (one.time_ns, other.time_ns) == (10**9, 0)


def test_the_same_seed_and_bytes_give_the_same_replies() -> None:
    def transcript(seed: int) -> list[bytes]:
        with connect(f"khep://obstacles?seed={seed}") as port:
            replies = []
            for _ in range(20):
                port.write(b"N\nD,8,9\n")
                replies += [port.readline(), port.readline()]
            return replies

    assert transcript(4) == transcript(4) != transcript(5)


def test_a_url_is_taken_apart() -> None:
    playpen, options = parse_url("khep://my%20arena.toml?seed=7&robot=1&noise=off&rom=4.06&mode=2&log=a.mcap")
    assert playpen == "my arena.toml"
    assert options == TwinOptions(seed=7, robot=1, noise=False, rom="4.06", mode=2, log="a.mcap")
    assert parse_url("khep:///tmp/x.toml")[0] == "/tmp/x.toml"


@pytest.mark.parametrize(
    ("url", "message"),
    [
        ("khep://", "no playpen named; expected a name or a path, such as khep://default"),
        ("khep://default?sed=1", "unknown option 'sed'; did you mean 'seed'?"),
        ("khep://default?seed=x", "seed = 'x'; expected an integer"),
        ("khep://default?seed=-1", "seed = -1; expected an integer"),
        ("khep://default?noise=maybe", "noise = 'maybe'; expected on or off"),
        ("khep://default?seed=1&seed=2", "option 'seed' is given twice"),
        ("khep://default?robot=3", "robot = 3: not in playpen 'default'; (choices: 0)"),
        ("khep://default?rom=6", "rom = '6': unknown;"),
        ("khep://default?mode=5", "mode = 5 with rom = '5.02': mode 5 waits for a program in S-records"),
        ("khep://nowhere", "nowhere: no such file"),
        ("khep://[", "khep://[: no URL: "),
        ("khep://default?log=a#b", "'#' ends a URL; expected %23 in its place"),
        ("khep://a?b.toml", "'?' starts the options of a URL; expected %3F in a name"),
        ("khep://default?seed=1_0", "seed = '1_0'; expected an integer"),
        ("khep://default?log=", ": cannot write a log here: this is a directory"),
        ("khep://default?log=/no/such/place/run.mcap", "/no/such/place/run.mcap: cannot write a log here"),
    ],
)
def test_what_cannot_be_opened_says_why_in_one_line(url: str, message: str) -> None:
    with pytest.raises(TwinPortError) as caught:
        connect(url)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)
    assert isinstance(caught.value, KhepTwinError)
    assert isinstance(caught.value, serial.SerialException)


def test_a_log_is_whole_when_the_port_is_closed(tmp_path: Path) -> None:
    log = tmp_path / "run.mcap"
    with connect(f"khep://default?log={log}") as port:
        ask(port, b"B\n")
        assert not log.exists()
    assert log.read_bytes().endswith(b"\x89MCAP0\r\n")
    assert [path.name for path in tmp_path.iterdir()] == ["run.mcap"]


def test_a_line_read_is_one_line_whatever_makes_the_robot_speak() -> None:
    url = "khep://default?fault=brown-out@0.5015"
    for timeout in (None, 2.0, 0.531):
        with connect(url, timeout=timeout) as port:
            line = port.readline()
            assert line == b"ROM of minirobot KHEPERA, "[: len(line)] or line.endswith(b"\r\n"), timeout
            assert line.count(b"\n") == (timeout != 0.531)
    with connect(url, timeout=None) as port:
        assert port.read(4) == b"ROM "
        # Control ticks come every 10 ms; the fault happens in the first one behind its start.
        assert port.time_ns == 510_000_000 + 4 * 11 * 10**9 // 9600


def test_a_poll_that_lets_several_lines_arrive_gives_one_of_them() -> None:
    with connect("khep://default?unpaced=on", timeout=0) as port:
        port.sleep(0.0001)
        port.twin.robot.send(b"B\nE\n", port.time_ns + 500_000)
        assert port.readline() == b"b,5.02,5.01\r\n"
        assert port.readline() == b"e,0,0\r\n"


def test_a_poll_costs_a_byte_at_the_speed_that_the_line_has_now() -> None:
    with connect(timeout=1) as port:
        assert ask(port, b"serial 115200\n") == b"serial 115200\r\n"
        port.timeout, start_ns = 0, port.time_ns
        assert (port.in_waiting, port.read(1)) == (0, b"")
        assert port.time_ns - start_ns == 2 * (11 * 10**9 // 115200)


def test_a_read_ends_with_any_text_or_at_a_number_of_bytes() -> None:
    with connect(timeout=1) as port:
        port.write(b"B\nB\nB\n")
        assert port.read_until(b"\r\n") == b"b,5.02,5.01\r\n"
        assert port.readline(4) == b"b,5."
        assert port.readline(100) == b"02,5.01\r\n"
        start_ns = port.time_ns
        assert port.read_until(b"no such text") == b"b,5.02,5.01\r\n"
        assert port.time_ns - start_ns == 10**9


def test_a_host_that_hangs_up_leaves_the_line_at_the_speed_that_it_set() -> None:
    with connect(timeout=1) as port:
        port.write(b"serial 38400\n")
        port.twin.robot.disconnect()
        port.baudrate = 38400
        start_ns = port.time_ns
        assert ask(port, b"B\n") == b"b,5.02,5.01\r\n"
        assert port.time_ns - start_ns == 2 * 11 * 10**9 // 38400 + 13 * 11 * 10**9 // 38400
