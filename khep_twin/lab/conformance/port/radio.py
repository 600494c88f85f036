"""Checks of a radio turret."""

from khep_twin.lab.conformance.port.check import (
    REFUSED,
    SETTLE,
    CheckedPort,
    Deviation,
    check,
    expect_range,
)
from khep_twin.units import RADIO_ALL, RADIO_BYTES, RADIO_NUMBER, RadioStatus

MESSAGE_TIME = 10.0
"""Longest time until a message is sent, or reported as failed [s] (assumed)."""

NOBODY = 255
"""Number that is not the number of any radio."""

_PAUSE = 0.05
"""Pause between two reads of the status [s]."""
_MAX_READS = 20
"""Largest number of messages that may wait to be read."""


def _order(receiver: int, length: int, *data: int) -> str:
    """Return the command S for a message, padded with zeros."""
    return ",".join(map(str, ("S", receiver, length, *data, *[0] * (RADIO_BYTES - len(data)))))


def _numbers(line: CheckedPort, message: str, count: int) -> list[int]:
    return line.numbers(f"T,{RADIO_NUMBER},{message}", count)


def _status(line: CheckedPort) -> RadioStatus:
    [status] = _numbers(line, "F", 1)
    expect_range(f"T,{RADIO_NUMBER},F", [status], 0, sum(RadioStatus))
    return RadioStatus(status)


def _wait_until_sent(line: CheckedPort) -> RadioStatus:
    """Return the status once the radio is ready to send."""
    end = line.time() + MESSAGE_TIME
    while not (status := _status(line)) & RadioStatus.READY:
        if line.time() > end:
            raise Deviation(f"a radio was not ready {MESSAGE_TIME:g} s after its message: status {status:d}")
        line.sleep(_PAUSE)
    return status


@check("a radio reports its version, its status and received messages", "simulators", turret=RADIO_NUMBER)
def reports(line: CheckedPort) -> None:
    expect_range(f"T,{RADIO_NUMBER},B", _numbers(line, "B", 2), 0, 255)
    _wait_until_sent(line)
    for _ in range(_MAX_READS):
        has_message = _status(line) & RadioStatus.RECEIVED
        sender, length, *data = _numbers(line, "R", 2 + RADIO_BYTES)
        expect_range("the sender of a message", [sender], 0, NOBODY)
        expect_range("the length of a message", [length], 0, RADIO_BYTES)
        expect_range("a byte of a message", data, 0, 255)
        if not has_message:
            return
    raise Deviation(f"a radio still had a message after {_MAX_READS} reads")


@check("a radio refuses unknown commands and wrong parameters", "assumed", turret=RADIO_NUMBER)
def refusals(line: CheckedPort) -> None:
    _wait_until_sent(line)
    _numbers(line, _order(RADIO_ALL, 0), 0)
    _wait_until_sent(line)
    invalid = ["S", f"S,{NOBODY},1,2", _order(NOBODY, 1) + ",0", _order(NOBODY, RADIO_BYTES + 1)]
    invalid += [_order(NOBODY, -1), _order(NOBODY, 1, 256), _order(NOBODY + 1, 1), _order(RADIO_ALL - 1, 1)]
    for message in (*invalid, "F,1", "R,1", "Q"):
        line.expect(f"T,{RADIO_NUMBER},{message}", REFUSED)
    if _wait_until_sent(line) & RadioStatus.FAILED:
        raise Deviation("a radio sent a message that it had refused")


@check("a radio's message to all needs no acknowledgement", "radio base manual, A", turret=RADIO_NUMBER)
def broadcast(line: CheckedPort) -> None:
    _wait_until_sent(line)
    _numbers(line, _order(RADIO_ALL, 5, *b"hello"), 0)
    if (status := _wait_until_sent(line)) & RadioStatus.FAILED:
        raise Deviation(f"a message to all failed: status {status:d}")


@check("a radio is not ready while it sends, and refuses a second message", "assumed", turret=RADIO_NUMBER)
def one_at_a_time(line: CheckedPort) -> None:
    _wait_until_sent(line)
    message = f"T,{RADIO_NUMBER},{_order(NOBODY, 1, 7)}"
    status_request = f"T,{RADIO_NUMBER},F"
    line.send(f"{message}\n{status_request}\n{message}\n")
    line.next_numbers(message, 0)
    [status] = line.next_numbers(status_request, 1)
    second = line.reply(message)
    if RadioStatus(status) & RadioStatus.READY:
        raise Deviation(f"a radio that sends has the status {status}; expected one without the first bit")
    if not second.startswith("z,"):
        raise Deviation(f"a second message was answered {second!r} during the first; expected 'z,…'")
    _wait_until_sent(line)


@check(
    "a message that no radio acknowledges is reported as failed until the next message",
    "radio base manual, 4.4",
    turret=RADIO_NUMBER,
)
def failure(line: CheckedPort) -> None:
    _wait_until_sent(line)
    _numbers(line, _order(NOBODY, RADIO_BYTES, *range(RADIO_BYTES)), 0)
    for _ in range(2):
        if not (status := _wait_until_sent(line)) & RadioStatus.FAILED:
            raise Deviation(f"a message to nobody did not fail: status {status:d}")
    _numbers(line, _order(RADIO_ALL, 0), 0)
    if (status := _wait_until_sent(line)) & RadioStatus.FAILED:
        raise Deviation(f"a radio reports the failure of an earlier message: status {status:d}")


@check("a restart drops the message that a radio sends", "assumed", turret=RADIO_NUMBER)
def restart(line: CheckedPort) -> None:
    _wait_until_sent(line)
    _numbers(line, _order(NOBODY, 1, 7), 0)
    line.send("restart\n")
    line.read_until_quiet(SETTLE)
    if (status := _status(line)) != RadioStatus.READY:
        raise Deviation(f"after a restart the radio has the status {status:d}; expected 1")
