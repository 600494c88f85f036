"""Machine of a robot: the time of transfers on its buses, its slaves, and its pins."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from khep_twin.programs.computer import READ_FLAG, Computer, Devices, Machine

BUS, ADDRESS, BYTE_NS = 2, 0x30, 25_000
COMPUTER = Computer({}, lambda robot: robot.devices, lambda number: {}, BYTE_NS)


class StepClock:
    """A clock without a world."""

    def __init__(self) -> None:
        self.time_ns = 0

    def advance_to(self, time_ns: int) -> None:
        """Advance."""
        assert time_ns > self.time_ns
        self.time_ns = time_ns


class Chip:
    """A slave that answers with the bytes that were written to it, repeated."""

    is_powered = True
    content = b"\0"

    def read(self, count: int) -> bytes:
        """Return bytes."""
        assert count > 0
        return (self.content * count)[:count]

    def write(self, message: bytes) -> None:
        """Keep the bytes."""
        assert message
        self.content = message


MESSAGES = st.lists(
    st.tuples(st.just(ADDRESS), st.sampled_from((0, READ_FLAG)), st.binary(max_size=80)), max_size=8
)


class BareRobot:
    """A robot with these devices alone, which is its model, too."""

    def __init__(self, devices: Devices, computer: Computer = COMPUTER) -> None:
        self.robot_model, self.devices, self.computer = self, devices, computer

    def load(self, *part: object) -> Computer:
        """Return its computer."""
        return self.computer


def machine_of(chip: Chip, clock: StepClock) -> Machine:
    return Machine(BareRobot(Devices({(BUS, ADDRESS): chip})), clock)  # type: ignore[arg-type]


@given(messages=MESSAGES, byte_ns=st.sampled_from((BYTE_NS, 1, 90_000)))
def test_a_message_of_n_bytes_takes_the_time_of_its_address_and_n_bytes(
    messages: list[tuple[int, int, bytes]], byte_ns: int
) -> None:
    clock = StepClock()
    reply = machine_of(Chip(), clock).transfer(BUS, messages, byte_ns)
    # With its address each message is one byte longer than its content.
    assert clock.time_ns == byte_ns * (sum(len(content) for _, _, content in messages) + len(messages))
    assert len(reply) == sum(len(content) for _, flags, content in messages if flags & READ_FLAG)


@pytest.mark.parametrize("fault", ["address", "bus", "power"])
def test_a_message_without_an_answer_takes_the_time_of_its_address(fault: str) -> None:
    clock, chip = StepClock(), Chip()
    chip.is_powered = fault != "power"
    with pytest.raises(OSError, match="no device has answered"):
        machine_of(chip, clock).transfer(
            BUS + (fault == "bus"), [(ADDRESS + (fault == "address"), 0, b"abc")], BYTE_NS
        )
    assert clock.time_ns == BYTE_NS


def test_slaves_of_the_same_address_on_two_buses_are_two() -> None:
    chips = [Chip(), Chip()]
    devices = Devices({(bus, ADDRESS): chip for bus, chip in enumerate(chips)})
    machine = Machine(BareRobot(devices), StepClock())  # type: ignore[arg-type]
    for bus, chip in enumerate(chips):
        machine.transfer(bus, [(ADDRESS, 0, bytes([bus + 7]))], 0)
        assert chip.content == machine.transfer(bus, [(ADDRESS, READ_FLAG, b"\0")], 0) == bytes([bus + 7])


def test_pins_keep_their_levels_and_the_devices_see_each_new_one() -> None:
    calls: list[tuple[int, int]] = []
    devices = Devices({}, {65: 1}, lambda pin, level: calls.append((pin, level)))
    machine = Machine(BareRobot(devices), StepClock())  # type: ignore[arg-type]
    assert (machine.pin(65), machine.pin(3)) == (1, 0)
    machine.set_pin(3, 5)
    machine.set_pin(65, 0)
    assert (machine.pin(65), machine.pin(3), calls) == (0, 1, [(3, 1), (65, 0)])


def test_time_never_goes_back() -> None:
    clock = StepClock()
    machine = machine_of(Chip(), clock)
    machine.advance_to(500)
    machine.advance_to(400)
    assert machine.time_ns == clock.time_ns == 500
