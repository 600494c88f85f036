"""The line in simulated time."""

from khep_twin.board.uart import QUEUE_LIMIT, SerialLine, Uart


def test_byte_k_arrives_after_k_times_eleven_bits() -> None:
    line = SerialLine(9600)
    last_ns = line.send(b"abc", 1000)
    arrivals = [line.arrival_ns(k) for k in (1, 2, 3)]
    assert arrivals == [1000 + k * 11_000_000_000 // 9600 for k in (1, 2, 3)]
    assert last_ns == arrivals[-1]


def test_a_burst_that_finds_the_line_busy_waits_for_it() -> None:
    line = SerialLine(9600)
    free_ns = line.send(b"ab", 0)
    line.send(b"c", 10)
    assert line.arrival_ns(3) == free_ns + 11_000_000_000 // 9600
    # A line that has been idle starts at once.
    assert line.send(b"d", 10**9) == 10**9 + 11_000_000_000 // 9600


def test_only_what_has_arrived_can_be_read() -> None:
    line = SerialLine(9600)
    line.send(b"abc", 0)
    second_ns = line.arrival_ns(2)
    assert second_ns is not None
    assert line.count_arrived(second_ns - 1) == 1
    assert line.read(second_ns - 1) == b"a"
    assert line.read(second_ns, limit=1) == b"b"
    assert line.next_ns == line.arrival_ns(1)
    assert line.read(10**9) == b"c"
    assert line.next_ns is None
    assert len(line) == 0


def test_a_byte_in_transit_is_found() -> None:
    line = SerialLine(9600)
    line.send(b"N\r\n", 0)
    assert line.count_to_end_of(b"\n") == 3
    assert line.count_to_end_of(b"\a") is None
    assert line.content == b"N\r\n"


def test_a_line_without_speed_takes_no_time() -> None:
    line = SerialLine(0)
    assert line.send(b"abc", 5) == 5
    assert line.read(5) == b"abc"


def test_what_is_taken_back_frees_the_line() -> None:
    line = SerialLine(9600)
    line.send(b"abc", 0)
    now_ns = line.arrival_ns(1) or 0
    line.flush(now_ns)
    assert line.send(b"d", now_ns) == now_ns + 11_000_000_000 // 9600
    assert line.read(10**9) == b"ad"


def test_the_queue_to_the_robot_is_bounded() -> None:
    uart = Uart(9600)
    uart.rx.send(bytes(QUEUE_LIMIT), 0)
    assert uart.free_capacity == 0
