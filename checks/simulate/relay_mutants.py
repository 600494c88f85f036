"""Broken builds of the relay, which the scenario `relay` must catch."""

# The breaks replace private functions.
# pyright: reportPrivateUsage=false

from collections.abc import Generator
from contextlib import AbstractContextManager, contextmanager
from typing import Any
from unittest.mock import PropertyMock, patch

import serial

from checks.simulate.mutants import Mutant
from khep_twin.log.line_recorder import LineRecorder
from khep_twin.ports import relay
from khep_twin.ports.idle_polls import IdlePolls


def _next_host_at_once() -> AbstractContextManager[object]:
    def settling(dialogue: Any, waiting: bytes) -> bool:
        dialogue.ended, dialogue._due = False, 0
        return False

    return patch.object(relay._Dialogue, "settling", settling)


def _replies_not_logged() -> AbstractContextManager[object]:
    sound = LineRecorder.on_bytes

    def on_bytes(recorder: LineRecorder, to_robot: bool, data: bytes) -> None:
        if to_robot or recorder._host_events:
            sound(recorder, to_robot, data)

    return patch.object(LineRecorder, "on_bytes", on_bytes)


def _lost_cables() -> AbstractContextManager[object]:
    @contextmanager
    def checked(device: relay.Device) -> Generator[None]:
        yield

    def read(device: relay.Device) -> bytes:
        try:
            return device._port.read(1024)
        except serial.SerialException:
            return b""

    return patch.multiple(relay.Device, read=read, unsent=PropertyMock(return_value=0), _checked=checked)


def _polls_passed() -> AbstractContextManager[object]:
    sound = IdlePolls.passed

    def passed(polls: IdlePolls, reply: bytes) -> bytes:
        sound(polls, reply)
        return reply

    return patch.object(IdlePolls, "passed", passed)


MUTANTS: dict[str, Mutant] = {
    "replies to a host that has left reach the next": Mutant("relay", "replies", _next_host_at_once),
    "the log of a line misses replies": Mutant("relay", "recovery", _replies_not_logged),
    "a relay goes on without its cable": Mutant("relay", "errors", _lost_cables),
    "replies to the relay's own questions reach hosts": Mutant("relay", "replies", _polls_passed),
    "the log of a line is never flushed": Mutant(
        "relay", "recovery", lambda: patch.object(LineRecorder, "flush", lambda recorder: None)
    ),
}
