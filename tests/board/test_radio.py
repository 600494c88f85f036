"""The radio turret's electronics: orders, replies, registers."""

import pytest

from khep_twin.board.radio import CAPACITY, ENTRY_SIZE, NAMES, RadioElectronics, RadioPhase, RadioRegister

NONE = ",0" * 16


@pytest.fixture
def radio() -> RadioElectronics:
    return RadioElectronics()


def order(to: int, length: int, *data: int) -> bytes:
    return b"S,%d,%d," % (to, length) + b",".join(b"%d" % byte for byte in data)


def hear(radio: RadioElectronics, sender: int, *data: int) -> None:
    """Puts a message into the buffer, as the body does."""
    start = RadioRegister.BUFFER + ENTRY_SIZE * int(radio.registers[RadioRegister.RECEIVED])
    entry = [sender, len(data), *data, *[0] * (16 - len(data))]
    radio.registers[start : start + ENTRY_SIZE] = entry
    radio.registers[RadioRegister.RECEIVED] += 1


WRONG_NUMBERS = [
    *("S", "S,2", "S,2,3,1,2,3", "S,2,3,1,2,3" + ",0" * 12, "S,2,3,1,2,3" + ",0" * 14),
    *("S,2,17" + NONE, "S,2,-1" + NONE, "S,-2,1" + NONE, "S,256,1" + NONE),
    *("S,2,1,256" + ",0" * 15, "S,2,1,-1" + ",0" * 15, "S,2,1" + ",0" * 15 + ",256", "S,2,1,x" + ",0" * 15),
    *("B,1", "F,0", "R,1"),
]


@pytest.mark.parametrize(
    ("message", "reply"),
    [
        ("B", "t,4,b,1,0"),
        ("F", "t,4,f,1"),
        ("R", "t,4,r,0,0" + NONE),
        ("S,2,0" + NONE, "t,4,s"),
        ("S,255,16" + ",255" * 16, "t,4,s"),
        ("S,-1,3,1,2,3" + ",0" * 13, "t,4,s"),
        ("S, 2, 3, 1, 2, 3" + ",0" * 13, "t,4,s"),
        *((message, "z,Protocol error") for message in WRONG_NUMBERS),
        *((message, "z,Turret order not supported") for message in ("J", "s,2,0" + NONE, "\xff")),
    ],
)
def test_every_order_gets_its_reply(radio: RadioElectronics, message: str, reply: str) -> None:
    assert radio.receive(message.encode("latin-1")) == reply.encode() + b"\r\n"


def test_a_refused_order_changes_nothing(radio: RadioElectronics) -> None:
    before = radio.registers.copy()
    radio.receive(b"S,2,17" + NONE.encode())
    assert (radio.registers == before).all()


def test_a_message_is_kept_with_zeros_behind_its_length(radio: RadioElectronics) -> None:
    radio.receive(order(2, 3, *range(10, 26)))
    assert radio.registers[RadioRegister.TO : RadioRegister.DATA + 5].tolist() == [2, 3, 10, 11, 12, 0, 0]


def test_a_second_message_waits_for_the_first(radio: RadioElectronics) -> None:
    assert radio.receive(order(2, 1, *[7] * 16)) == b"t,4,s\r\n"
    before = radio.registers.copy()
    assert radio.receive(b"F") == b"t,4,f,0\r\n"
    assert radio.receive(order(3, 1, *[8] * 16)) == b"z,Radio is sending\r\n"
    assert (radio.registers == before).all()


def test_messages_are_read_in_the_order_of_their_arrival(radio: RadioElectronics) -> None:
    for sender in range(1, 1 + CAPACITY):
        hear(radio, sender, sender * 10, 255)
    for sender in range(1, 1 + CAPACITY):
        assert radio.receive(b"F") == b"t,4,f,3\r\n"
        assert radio.receive(b"R") == f"t,4,r,{sender},2,{sender * 10},255{',0' * 14}\r\n".encode()
    assert radio.receive(b"F") == b"t,4,f,1\r\n"
    assert radio.receive(b"R") == b"t,4,r,0,0" + NONE.encode() + b"\r\n"


def test_the_status_tells_of_a_failure_until_the_next_message(radio: RadioElectronics) -> None:
    radio.registers[RadioRegister.HAS_FAILED] = 1
    assert radio.receive(b"F") == b"t,4,f,5\r\n"
    assert radio.receive(b"F") == b"t,4,f,5\r\n"
    radio.receive(order(2, 0, *[0] * 16))
    assert radio.receive(b"F") == b"t,4,f,0\r\n"


def test_the_status_tells_of_a_full_buffer_until_the_next_read(radio: RadioElectronics) -> None:
    hear(radio, 1, 1)
    radio.registers[RadioRegister.HAS_OVERRUN] = 1
    assert radio.receive(b"F") == b"t,4,f,11\r\n"
    radio.receive(b"R")
    assert radio.receive(b"F") == b"t,4,f,1\r\n"


def test_a_reset_drops_all_but_the_number_of_the_draws(radio: RadioElectronics) -> None:
    radio.receive(order(2, 1, *[7] * 16))
    hear(radio, 1, 1)
    radio.registers[RadioRegister.TRANSMISSIONS] = 12
    radio.registers[[RadioRegister.HAS_FAILED, RadioRegister.HAS_OVERRUN]] = 1
    radio.reset()
    assert radio.receive(b"F") == b"t,4,f,1\r\n"
    assert radio.registers[RadioRegister.PHASE] == RadioPhase.IDLE
    assert radio.registers[RadioRegister.TRANSMISSIONS] == 12
    assert radio.registers.sum() == 12


def test_every_register_has_a_name_of_its_own(radio: RadioElectronics) -> None:
    assert len(set(NAMES)) == len(NAMES) == len(radio.registers)
    assert NAMES[RadioRegister.BUFFER + ENTRY_SIZE] == "received_1_sender"
    assert NAMES[RadioRegister.LENGTH] == "length"
