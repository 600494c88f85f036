"""Broken builds of the recorder, of recovery and of repetition, which the scenario `record` must catch."""

# The breaks replace private functions.
# pyright: reportPrivateUsage=false

from collections.abc import Iterator
from contextlib import nullcontext, suppress
from pathlib import Path
from typing import Any

from checks.simulate.mutants import Broken, Mutant, nothing, replaced
from khep_twin.lab.experiment import repeat as repetition
from khep_twin.log import log_file, recorder
from khep_twin.log.log_file import LogFile, PartFile
from khep_twin.log.mcap_recovery import IntactRecords
from khep_twin.log.recorder import Recorder
from khep_twin.log.transcript import Transcript
from khep_twin.ports.serve import PeriodicFlush


def _write_once(self: Any, data: bytes) -> int:
    """Take a short write for a whole one."""
    log_file.os.write(self._descriptor, data)
    self._size += len(data)
    return len(data)


def _write_without_truncation(self: Any, data: bytes) -> int:
    """Leave the written part of a record that does not fit, and continue after it."""
    rest = memoryview(data)
    try:
        while rest:
            rest = rest[log_file.os.write(self._descriptor, rest) :]
    except OSError:
        rest = rest[:0]
    self._size += len(data)
    return len(data)


def _finish_early(self: Any) -> None:
    """Rename a log before its summary is written."""
    with self.error_guard():
        log_file.os.replace(self.part, self._target)
        self._writer.finish()
        self._close()


def _finish_without_fsync(self: Any) -> None:
    """Rename a log before it is on the disk."""
    with self.error_guard():
        self._writer.finish()
        log_file.os.replace(self.part, self._target)
        self._close()


_messages = IntactRecords.messages


def _without_last(self: Any, *arguments: Any) -> Iterator[Any]:
    """Drop the last piece of a log."""
    self._message_sources = self._message_sources[:-1]
    return _messages(self, *arguments)


_write_lines = Transcript.write


def _lose_a_line(self: Any) -> None:
    """Forget the last bytes at a flush, if there are many."""
    if len(self._received) > 5:
        self._received.pop()
    _write_lines(self)


def _forget_failures(self: Any) -> Any:
    """Continue after an error of the file as if nothing had happened."""
    return suppress(OSError)


def _remove(part: Path) -> Path | None:
    """Remove the remains of an earlier run."""
    part.unlink(missing_ok=True)
    return None


_broken: dict[str, tuple[str, Broken]] = {
    "a short write is taken for whole": ("recovery", replaced(PartFile, write=_write_once)),
    "a failed write is not taken back": ("recovery", replaced(PartFile, write=_write_without_truncation)),
    "the next run overwrites the remains": ("leftovers", replaced(log_file, rename_unfinished=_remove)),
    "logs are renamed before the summary": ("recovery", replaced(LogFile, finish=_finish_early)),
    "logs are renamed before they are on the disk": (
        "recovery",
        replaced(LogFile, finish=_finish_without_fsync),
    ),
    "lock-step runs are hardly ever flushed": ("recovery", replaced(recorder, _BATCH_SAMPLES=10**9)),
    "served runs are never flushed": ("recovery", replaced(PeriodicFlush, __call__=nothing)),
    "a recovery drops the last piece": ("recovery", replaced(IntactRecords, messages=_without_last)),
    "a flush loses a line": ("recovery", replaced(Transcript, write=_lose_a_line)),
    "errors of the file are swallowed": ("leftovers", replaced(LogFile, error_guard=_forget_failures)),
    "errors of the file are not put into words": (
        "errors",
        replaced(LogFile, error_guard=lambda _: nullcontext()),
    ),
    "host events are left out": ("recovery", replaced(Recorder, on_host_event=nothing)),
    "repetition repeats nothing": ("repeat", replaced(repetition, repeat_event=nothing)),
}

MUTANTS = {name: Mutant("record", *broken, seconds=600) for name, broken in _broken.items()}
