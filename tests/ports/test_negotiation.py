"""RFC 2217: negotiations of hosts, valid and invalid, and their answers."""

import socket
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from served_twin import all_of, connected, served, stop

from checks.fuzz.libfuzzer import run_libfuzzer
from checks.fuzz.rfc2217 import BEGIN, END, ODD, WELL_FORMED, check, seeds
from khep_twin.board.uart import LineSettings
from khep_twin.log.reader import read_log
from khep_twin.ports.negotiation import HIGHEST_BAUD, LOWEST_BAUD, MAX_CONTENT_BYTES, SIGNATURE, Negotiator

SHARE = 2_000

TOO_SHORT = ["01 01", "01", "02", "03", "04", "0a", "0b"]

OUT_OF_RANGE = {
    "01 00 00 00 01": "65 00 00 25 80",
    "01 ff ff ff ff ff ff ff ff": "65 00 00 25 80",
    "02 04": "66 08",
    "02 4d": "66 08",
    "03 4d": "67 01",
    "04 09": "68 02",
}
"""Negotiations with an invalid value, and their answers."""

GREETING = bytes.fromhex("fffb01 fffb03 fffd00 fffb2c")


def negotiate(*sent: bytes) -> tuple[bytes, bytes, Negotiator]:
    """Return the bytes for the robot, the answers, and the negotiator."""
    answers = bytearray()
    negotiator = Negotiator(9600, answers.extend)
    answers.clear()
    data = b"".join(map(negotiator.decode, sent))
    return data, bytes(answers), negotiator


@pytest.mark.parametrize("wrong", TOO_SHORT)
def test_a_value_too_short_is_a_fault_that_shows_the_bytes(wrong: str) -> None:
    data, answers, negotiator = negotiate(b"B\n" + BEGIN + bytes.fromhex(wrong) + END + b"N\n", b"E\n")
    assert negotiator.fault.startswith(f"negotiation ff fa 2c {wrong} ff f0 cannot be understood; expected ")
    assert (data, answers) == (b"B\n", b"")


def test_an_end_without_a_beginning_is_a_fault() -> None:
    data, _, negotiator = negotiate(b"B\n" + END + b"N\n")
    assert negotiator.fault.startswith("negotiation ff f0 cannot be understood")
    assert data == b"B\n"


@pytest.mark.parametrize("piece", [1, 7, 10_000])
def test_a_negotiation_without_an_end_is_a_fault_before_it_takes_memory(piece: int) -> None:
    sent = BEGIN + b"x" * 10_000
    _, _, negotiator = negotiate(*(sent[at : at + piece] for at in range(0, len(sent), piece)))
    assert "78 78 ... without an end cannot be understood" in negotiator.fault
    assert len(negotiator.fault) < 300


@pytest.mark.parametrize(("wrong", "answer"), OUT_OF_RANGE.items())
def test_a_value_out_of_range_is_answered_with_the_one_in_force(wrong: str, answer: str) -> None:
    data, answers, negotiator = negotiate(BEGIN + bytes.fromhex(wrong) + END + b"B\n")
    assert answers == BEGIN + bytes.fromhex(answer) + END
    assert data == b"B\n"
    assert not negotiator.fault
    assert negotiator.settings() == LineSettings(9600, 2)


@pytest.mark.parametrize(
    ("mask", "answer"), [("0a 00", "6e 00"), ("0b ff ff", "6f ff ff"), ("0b 10", "6f 10")]
)
def test_a_mask_of_notices_is_confirmed(mask: str, answer: str) -> None:
    data, answers, negotiator = negotiate(BEGIN + bytes.fromhex(mask) + END + b"B\n")
    assert (data, answers, negotiator.fault) == (b"B\n", BEGIN + bytes.fromhex(answer) + END, "")


def test_states_of_the_line_are_told() -> None:
    request = b"".join(BEGIN + bytes((5, state)) + END for state in (4, 7, 10, 8, 9, 7))
    notices = b"".join(BEGIN + bytes((105, state)) + END for state in (6, 8, 11, 8, 9, 9))
    assert negotiate(request)[1] == notices


def test_the_twin_signs_where_it_is_asked_to() -> None:
    data, answers, negotiator = negotiate(BEGIN + b"\0" + END + BEGIN + b"\0a host" + END + b"B\n")
    assert answers == BEGIN + b"\x64" + SIGNATURE + END
    assert SIGNATURE.startswith(b"khep_twin ")
    assert (data, negotiator.fault) == (b"B\n", "")


@pytest.mark.parametrize(
    ("state", "in_force"), [*((value, 14) for value in (13, 14, 15, 16, 18)), (17, 1), (19, 1)]
)
def test_flow_control_that_there_is_not_is_answered_with_what_is_in_force(state: int, in_force: int) -> None:
    assert negotiate(BEGIN + bytes((5, state)) + END)[1] == BEGIN + bytes((105, in_force)) + END


@pytest.mark.parametrize("baud", [LOWEST_BAUD, 19200, HIGHEST_BAUD])
def test_a_value_in_range_is_taken(baud: int) -> None:
    value = b"\x01" + baud.to_bytes(4, "big")
    _, answers, negotiator = negotiate(BEGIN + value + END + BEGIN + b"\x04\x01" + END)
    assert answers == BEGIN + b"\x65" + value[1:] + END + BEGIN + b"\x68\x01" + END
    assert negotiator.settings() == LineSettings(baud, 1)


def test_a_nul_behind_a_carriage_return_is_part_of_the_line_end() -> None:
    assert negotiate(b"\xff\xfc\x00B\r", b"\0N\r\0\0")[0] == b"B\rN\r\0"


@pytest.mark.parametrize(
    "harmless", ["05", "05 63", "0c", "0c 09", "63 01", "", "00" + " 41" * (MAX_CONTENT_BYTES - 2)]
)
def test_what_has_no_answer_is_passed_over(harmless: str) -> None:
    data, answers, negotiator = negotiate(BEGIN + bytes.fromhex(harmless) + END + b"B\n")
    assert (data, answers, negotiator.fault) == (b"B\n", b"", "")


def test_a_share_of_the_fuzzing_finds_nothing(tmp_path: Path) -> None:
    run_libfuzzer("fuzz-rfc2217", SHARE, tmp_path)


@settings(max_examples=300, derandomize=True, database=None, deadline=None)
@given(st.binary(max_size=60))
def test_any_bytes_are_negotiated_with(data: bytes) -> None:
    check(data)


def test_the_seeds_have_what_clients_send(tmp_path: Path) -> None:
    seeds(tmp_path)
    files = [path.read_bytes() for path in tmp_path.iterdir()]
    assert len(files) > len(WELL_FORMED + ODD)
    for data in files:
        check(data)


@pytest.mark.parametrize("wrong", [b"", b"B\n\n", BEGIN + b"\x02\x07" + END])
def test_a_negotiator_that_works_wrongly_is_noticed(monkeypatch: pytest.MonkeyPatch, wrong: bytes) -> None:
    def decode_wrongly(self: Negotiator, data: bytes) -> bytes:
        return wrong

    monkeypatch.setattr(Negotiator, "decode", decode_wrongly)
    with pytest.raises(AssertionError):
        check(b"\0B\n" + BEGIN + b"\x02\x07" + END)


def test_no_negotiation_ends_a_server_or_its_log(tmp_path: Path) -> None:
    log = tmp_path / "run.mcap"
    with served("default", "--rfc2217", ":0", "--log", str(log)) as (process, url):
        for wrong in TOO_SHORT:
            with connected(url) as host:
                host.sendall(BEGIN + bytes.fromhex(wrong) + END)
                assert all_of(host) == GREETING
        with connected(url) as host:
            for odd in OUT_OF_RANGE:
                host.sendall(BEGIN + bytes.fromhex(odd) + END)
            host.sendall(b"B\n")
            host.shutdown(socket.SHUT_WR)
            answers = b"".join(BEGIN + bytes.fromhex(answer) + END for answer in OUT_OF_RANGE.values())
            assert all_of(host) == GREETING + answers + b"b,5.02,5.01\r\n"
        code, errors = stop(process)
    assert code == 0
    notices = [line.text for line in read_log(log).events if "cut off" in line.text]
    assert len(notices) == len(TOO_SHORT)
    for wrong, line in zip(TOO_SHORT, notices, strict=True):
        assert line.startswith(
            f"a host, 127.0.0.1, was cut off: negotiation ff fa 2c {wrong} ff f0 cannot be"
        )
        assert line in errors
