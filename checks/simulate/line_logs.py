"""Logs of a relay's line, compared with the bytes that its cable has carried."""

from pathlib import Path

from checks.simulate.cable import Account, Cable
from checks.simulate.log_readings import read_in_every_way
from checks.simulate.log_truth import WALL_LOSS_NS
from checks.simulate.simulation import Simulation
from khep_twin.errors import LogError
from khep_twin.log.decoding import read_line
from khep_twin.log.host_events import read_events
from khep_twin.log.line_recorder import ROBOT
from khep_twin.log.reader import read_raw
from khep_twin.log.recover import recover, summary


class LineLog:
    """Log of one relay after the other, each under the same name.

    Args:
        simulation: Simulation.
        cable: Cable of the relay.

    Attributes:
        path: Path of the finished log.
    """

    def __init__(self, simulation: Simulation, cable: Cable) -> None:
        self._simulation, self._cable = simulation, cable
        self.path = simulation.folder / "line.mcap"
        self._n_accounts = 0
        self._flushed_counts = (0, 0)
        self._turns: list[tuple[int, int, int]] = []

    def begin(self) -> None:
        """Note the start of a relay."""
        self._n_accounts, self._flushed_counts = len(self._cable.accounts), (0, 0)
        self._turns.clear()

    @property
    def is_begun(self) -> bool:
        """True if the present relay has opened the device."""
        return len(self._cable.accounts) > self._n_accounts

    @property
    def _account(self) -> Account:
        return self._cable.accounts[-1] if self.is_begun else Account()

    def turn(self) -> None:
        """Note the start of an iteration of the relay's loop: bytes before the last flush are in the log."""
        now_ns, account, turns = self._simulation.kernel.now_ns, self._account, self._turns
        while turns and now_ns - turns[0][0] > WALL_LOSS_NS:
            _, *counts = turns.pop(0)
            self._flushed_counts = counts[0], counts[1]
        turns.append((now_ns, len(account.sent), len(account.received)))

    def check(self, *, is_complete: bool) -> None:
        """Check the log of a relay that has ended, and remove it.

        Args:
            is_complete: True if the relay was not killed, so that nothing may be missing.
        """
        simulation, part = self._simulation, self.path.with_name(f"{self.path.name}.part")
        if part.exists():
            if is_complete:
                simulation.violate("leftovers", f"the relay has ended, and left {part.name}")
            try:
                rescue = recover(part)
            except LogError as error:
                if "nothing to rescue" not in str(error):
                    raise
            else:
                summary(part, rescue)
                simulation.count("logs recovered")
                self._compare(rescue.path, is_complete=False)
                rescue.path.unlink()
            part.unlink()
        if self.path.exists():
            read_in_every_way(simulation, self.path, False)
            simulation.count("logs finished")
            self._compare(self.path, is_complete=True)
            self.path.unlink()
        elif is_complete and self.is_begun:
            simulation.violate("leftovers", "the relay has ended, and there is no log")

    def _compare(self, path: Path, *, is_complete: bool) -> None:
        """Compare a log with the bytes that the cable has carried: their first part, or all of them."""
        simulation, account = self._simulation, self._account
        _, messages, _ = read_raw(path, lambda _: True)
        n_sent, n_heard = (len(account.sent), len(account.received)) if is_complete else self._flushed_counts
        texts = [read_line(data).text for _, data in messages.get("/events", ())]
        events = [
            event for _, data in messages.get(f"/{ROBOT}/host_events", ()) for event in read_events(data)
        ]
        sent = b"".join(event.data for _, event in events)
        # Dropped bytes are in the log, and not on the line.
        if not any("were dropped" in text for text in texts):
            n_both = min(len(sent), len(account.sent))
            if sent[:n_both] != account.sent[:n_both] or len(sent) < n_sent:
                self._violate(path, "to", sent, bytes(account.sent), n_sent)
        lines = [read_line(data) for _, data in messages.get(f"/{ROBOT}/serial", ())]
        replies = [line.text for line in lines if line.name == "robot"]
        true = _lines(bytes(account.received))
        n_certain = len(_lines(account.received[:n_heard], False))
        if replies[: len(true)] != true[: len(replies)] or len(replies) < n_certain:
            self._violate(path, "from", replies, true, n_heard)
        simulation.count("bytes logged", len(sent))

    def _violate(self, path: Path, way: str, logged: object, true: object, count: int) -> None:
        text = f"{path.name}: {str(logged)[-200:]} {way} the robot; the line has carried {str(true)[-200:]}"
        self._simulation.violate("recovery", f"{text}, {count} of it for certain")


def _lines(data: bytes | bytearray, with_rest: bool = True) -> list[str]:
    """Return lines as a log has them."""
    *lines, rest = bytes(data).replace(b"\r", b"\n").split(b"\n")
    lines += [rest] if with_rest else []
    return [line.decode("latin-1").encode("unicode_escape").decode("ascii") for line in lines if line]
