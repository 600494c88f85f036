"""Machine of a Khepera IV: the time of transfers on its bus, and its pins."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from khep_twin.robots.khepera4.machine import BYTE_NS, CHARGER_PIN, READ_FLAG, RESET_PIN, Machine
from khep_twin.robots.khepera4.registers import ADDRESS


class Clock:
    """A clock without a world."""

    def __init__(self) -> None:
        self.time_ns = 0

    def advance_to(self, time_ns: int) -> None:
        """Advance."""
        assert time_ns > self.time_ns
        self.time_ns = time_ns


class Chip:
    """A microcontroller that answers with a count of the bytes."""

    is_powered = True
    n_resets = 0

    def read(self, register: int, length: int) -> bytes:
        """Return bytes that start with the register."""
        return bytes((register + offset) % 256 for offset in range(length))

    def write(self, content: bytes) -> None:
        """Take any bytes."""

    def reset(self) -> None:
        """Count the resets."""
        self.n_resets += 1


MESSAGES = st.lists(
    st.tuples(st.just(ADDRESS), st.sampled_from((0, READ_FLAG)), st.binary(max_size=80)), max_size=8
)


@given(messages=MESSAGES, byte_ns=st.sampled_from((BYTE_NS, 1, 90_000)))
def test_a_message_of_n_bytes_takes_the_time_of_its_address_and_n_bytes(
    messages: list[tuple[int, int, bytes]], byte_ns: int
) -> None:
    clock = Clock()
    reply = Machine(Chip(), clock).transfer(messages, byte_ns)  # type: ignore[arg-type]
    # With its address each message is one byte longer than its content.
    assert clock.time_ns == byte_ns * (sum(len(content) for _, _, content in messages) + len(messages))
    assert len(reply) == sum(len(content) for _, flags, content in messages if flags & READ_FLAG)


def test_a_byte_takes_25_us_by_default() -> None:
    clock = Clock()
    Machine(Chip(), clock).transfer([(ADDRESS, 0, b"ab")])  # type: ignore[arg-type]
    assert clock.time_ns == 3 * 25_000


def test_a_read_begins_at_the_register_of_the_last_write() -> None:
    machine = Machine(Chip(), Clock())  # type: ignore[arg-type]
    machine.transfer([(ADDRESS, 0, bytes((7, 1)))])
    assert machine.transfer([(ADDRESS, READ_FLAG, bytes(3))]) == bytes((7, 8, 9))
    assert machine.transfer([(ADDRESS, 0, b""), (ADDRESS, READ_FLAG, bytes(1))]) == bytes((7,))


@pytest.mark.parametrize("fault", ["address", "reset", "power"])
def test_a_message_without_an_answer_takes_no_time(fault: str) -> None:
    clock, chip = Clock(), Chip()
    machine = Machine(chip, clock)  # type: ignore[arg-type]
    chip.is_powered = fault != "power"
    if fault == "reset":
        machine.set_pin(RESET_PIN, 0)
    with pytest.raises(OSError, match="no device has answered"):
        machine.transfer([(ADDRESS + (fault == "address"), 0, b"abc")])
    assert clock.time_ns == 0


def test_pins_keep_their_levels_and_reset_at_0_only() -> None:
    chip = Chip()
    machine = Machine(chip, Clock())  # type: ignore[arg-type]
    assert (machine.pin(CHARGER_PIN), machine.pin(RESET_PIN), machine.pin(3)) == (1, 1, 0)
    machine.set_pin(3, 5)
    machine.set_pin(RESET_PIN, 1)
    assert (machine.pin(3), chip.n_resets) == (1, 0)
    machine.set_pin(RESET_PIN, 0)
    assert (machine.pin(RESET_PIN), chip.n_resets) == (0, 1)


def test_time_never_goes_back() -> None:
    clock = Clock()
    machine = Machine(Chip(), clock)  # type: ignore[arg-type]
    machine.advance_to(500)
    machine.advance_to(400)
    assert machine.time_ns == clock.time_ns == 500
