"""Broken builds of the relay, which the scenario `relay` must catch."""

# The breaks replace private functions.
# pyright: reportPrivateUsage=false

from contextlib import nullcontext
from typing import Any
from unittest.mock import PropertyMock

import serial

from checks.simulate.mutants import Mutant, nothing, replaced
from khep_twin.log.line_recorder import LineRecorder
from khep_twin.ports import relay
from khep_twin.ports.idle_polls import IdlePolls

_on_bytes, _filter_replies = LineRecorder.on_bytes, IdlePolls.filter_replies


def _next_host_at_once(dialogue: Any, _: bytes) -> bool:
    dialogue.is_draining, dialogue._n_due = False, 0
    return False


def _log_no_replies(recorder: LineRecorder, to_robot: bool, data: bytes) -> None:
    if to_robot or recorder._host_events:
        _on_bytes(recorder, to_robot, data)


def _read_from_any(device: relay.Device) -> bytes:
    try:
        return device._port.read(1024)
    except serial.SerialException:
        return b""


def _pass_polls(polls: IdlePolls, reply: bytes) -> bytes:
    _filter_replies(polls, reply)
    return reply


MUTANTS: dict[str, Mutant] = {
    "replies to a host that has left reach the next": Mutant(
        "relay", "replies", replaced(relay._Dialogue, check_draining=_next_host_at_once)
    ),
    "the log of a line misses replies": Mutant(
        "relay", "recovery", replaced(LineRecorder, on_bytes=_log_no_replies)
    ),
    "a relay goes on without its cable": Mutant(
        "relay",
        "errors",
        replaced(
            relay.Device,
            read=_read_from_any,
            unsent=PropertyMock(return_value=0),
            _converted_failures=lambda device: nullcontext(),
        ),
    ),
    "replies to the relay's own questions reach hosts": Mutant(
        "relay", "replies", replaced(IdlePolls, filter_replies=_pass_polls)
    ),
    "the log of a line is never flushed": Mutant("relay", "recovery", replaced(LineRecorder, flush=nothing)),
}
