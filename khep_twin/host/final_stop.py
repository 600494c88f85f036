"""Final stop of a robot's motors, at the end of a program or of its run."""

from contextlib import suppress
from typing import NamedTuple

from khep_twin.errors import PortError, PortTimeout
from khep_twin.host.resynchronization import Resynchronization
from khep_twin.host.robot_port import RobotPort
from khep_twin.process.signals import register_cleanup

STOP_WAIT = 0.5
"""Longest wait for the reply to the final command, which stops the motors [s]."""


class StopResult(NamedTuple):
    """Result of a final stop.

    Attributes:
        is_stopped: Whether the robot has confirmed the stop.
        outcome: Description, for messages.
    """

    is_stopped: bool
    outcome: str


class FinalStop:
    """Final stop of one robot; a signal that ends the process also stops its motors.

    Args:
        port: Port of the robot.
        requests: Requests that stop the motors, one after the other.
        resynchronization: Resynchronization of the line.
    """

    def __init__(
        self, port: RobotPort, requests: tuple[str, ...], resynchronization: Resynchronization
    ) -> None:
        self._port = port
        self._requests = requests
        self._resynchronization = resynchronization
        self._unregister = register_cleanup(self.stop_at_exit)

    def stop(self, limit: float = STOP_WAIT) -> None:
        """Send the requests that stop the motors, each for up to `limit` [s], until they are confirmed.

        Raises:
            PortError: The motors could not be stopped.
        """
        wait = STOP_WAIT / 2
        timeout = self._port.serial_port.timeout
        if timeout is None or not 0 < timeout <= wait:
            self._port.set_timeout(wait, self._requests[-1])
        for request in self._requests:
            if not any(self._confirms_stop(request, wait, attempt) for attempt in range(round(limit / wait))):
                raise PortTimeout(f"{self._port.name}: no reply to {request!r} within {limit:.2g} s")

    def hold(self) -> None:
        """Stop the motors of a port that stays open.

        Raises:
            PortError: The motors could not be stopped.
        """
        timeout = self._port.serial_port.timeout
        self.stop()
        self._port.set_timeout(timeout, self._requests[-1])

    def halt(self) -> StopResult:
        """Try to stop the motors, and close the port: `Line.halt`."""
        # A line that has just been silent is not waited for again.
        is_silent = bool(self._resynchronization.unanswered)
        try:
            try:
                self.stop(STOP_WAIT if is_silent else max(STOP_WAIT, self._port.silence_limit))
                return StopResult(True, "the motors were stopped")
            except PortError as error:
                reason = self._reason(error)
            finally:
                self._close()
            if refusal := self._port.reopening_refusal():
                return StopResult(False, f"the motors may still run: {reason}; {refusal}")
            try:
                self._port.reopen(STOP_WAIT)
                self.stop()
            except PortError as error:
                text = f"the motors may still run: opening the port again failed: {self._reason(error)}"
                return StopResult(False, text)
            return StopResult(True, "the port was opened again and the motors were stopped")
        finally:
            self._close()

    def stop_at_exit(self) -> None:
        """Stop the motors of a robot when a signal ends the process, even during an exchange."""
        if not hasattr(self._port.serial_port, "time_ns"):
            with suppress(PortError):
                self.stop()

    def _confirms_stop(self, request: str, wait: float, attempt: int) -> bool:
        """Send a request that stops the motors; return whether the robot confirms it."""
        framing = self._port.framing
        # A pending reply to a speed command looks the same.
        is_pending = framing.command(request) in self._resynchronization.unanswered
        if not is_pending or not attempt:
            self._port.send([request], resync=True)
        if is_pending:
            late_replies = self._resynchronization.resynchronize()
            if not attempt or late_replies is None:
                return bool(late_replies) and framing.answers(request, late_replies[-1])
            # A robot that drops input before its reply has dropped the first probe, or the request.
            self._port.send([request], resync=True)
        end = self._port.timeout_time + wait
        reply: str | None = ""
        while reply is not None and self._port.timeout_time <= end:
            reply, _ = self._port.read_reply(request)
            if reply is not None and framing.answers(request, reply):
                self._resynchronization.unanswered.clear()  # earlier replies came before it
                return True
        return False

    def _reason(self, error: PortError) -> str:
        return str(error).removeprefix(f"{self._port.name}: ")

    def _close(self) -> None:
        self._unregister()
        self._port.close()
