"""Branches of logged runs: a new log begins as the old one, and other hosts may take over."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from khep_twin.clock import NS_PER_S
from khep_twin.errors import LogError, PortError
from khep_twin.files.atomic import is_same
from khep_twin.files.text import encodable
from khep_twin.log.entries import Label
from khep_twin.log.reader import hash_file, read_end_ns
from khep_twin.log.recorded import BRANCH, BranchPoint, read_changes, changes_text
from khep_twin.log.run_description import LogPrefix, versions
from khep_twin.ports.resume import ResumedRun, resume_run
from khep_twin.ports.twin import Twin
from khep_twin.units import STEP_NS


class Described(NamedTuple):
    """Facts and attachments of a log."""

    facts: Mapping[str, str] = {}
    attachments: Mapping[str, str] = {}


_NOTHING = Described()


def branch_off(
    path: Path,
    change: BranchPoint,
    log: Path | None = None,
    more: Described = _NOTHING,
    on_failure: Callable[[str], None] | None = None,
    *,
    same: bool = False,
) -> ResumedRun:
    """Take up the run of a log, and change it; the recorded hosts are still there.

    Args:
        path: Path of the log.
        change: Moment, and what is different from then on.
        same: True if nothing is, so that the recorded run goes on with its own later changes.
        log: Path of a new log, which begins as the old one; None for none.
        more: More facts and attachments of the new log.
        on_failure: Function that takes the line about a log that cannot be written any more; None to end.

    Raises:
        LogError: The log lacks what that needs, or the new one cannot be written.
        KhepTwinError: The change cannot be made.
    """
    last_ns = read_end_ns(path)
    if not last_ns:
        raise LogError(f"{path}: the run ends at 0 s; expected one that lasts longer, to take it up")
    if not 0 < change.at_ns <= last_ns:
        found = f"{path}: the run cannot be resumed at {change.at_ns / NS_PER_S:g} s"
        raise LogError(f"{found}; expected above 0 and up to its end at {last_ns / NS_PER_S:g} s")
    if log is not None and is_same(log, path):
        raise LogError(f"{log}: this is the log that is resumed; expected a separate file")
    begun: list[Twin] = []

    def start(twin: Twin, label: Label, beginning: LogPrefix) -> None:
        told = replace(change, parent=encodable(path.name), sha256=hash_file(path))
        facts = {
            **label.metadata,
            **versions(),
            **more.facts,
            "parent": told.parent,
            "parent_sha256": told.sha256,
            "branched_at_s": f"{told.at_ns / NS_PER_S:.9g}",
        }
        before = [each for each in read_changes(path, label) if each.at_ns < told.at_ns]
        later = [each for each in read_changes(path, label) if same and each.at_ns >= told.at_ns]
        text = changes_text([*before, told, *later])
        attachments = {**label.attachments, BRANCH: text, **more.attachments}
        begun.append(twin)
        if log is not None:
            twin.record(log, facts=facts, attachments=attachments, beginning=beginning, on_failure=on_failure)

    try:
        # A run that stays the same need not stop amid a step.
        at_ns = change.at_ns // STEP_NS * STEP_NS if same else change.at_ns
        resumed = resume_run(path, at_ns, None if log is None else start)
        if not same:
            resumed.later.clear()
            resumed.change(change)
    except BaseException:
        for recorder in filter(None, [twin.recorder for twin in begun]):
            recorder.discard()
        raise
    return resumed


def open_log(
    path: Path,
    change: BranchPoint,
    robot: int | None,
    log: Path | None = None,
    *,
    served: bool = False,
    on_failure: Callable[[str], None] | None = None,
) -> Twin:
    """Take up the run of a log for other hosts, as `branch_off` does.

    The robot on the line is that of this index; of None that of the log, or of a run that is served all.

    Raises:
        KhepTwinError: As `branch_off`; or there is no such robot.
    """
    resumed = branch_off(path, change, log, on_failure=on_failure)
    there = range(len(resumed.twin.world.robots))
    if robot is None and not served:
        robot = resumed.setup.options.robot or 0
    if robot is not None and robot not in there:
        if resumed.twin.recorder is not None:
            resumed.twin.recorder.discard()
        raise PortError(f"robot = {robot}: not in {path}", key="robot", value=robot, expected=there)
    on_the_line = there if robot is None else [robot]
    for index in on_the_line:
        resumed.hosts.replace(index)
    world, options = resumed.twin.world, resumed.twin.options
    twin = Twin(world, tuple(world.robots[index] for index in on_the_line), options, resumed.hosts)
    twin.recorder = resumed.twin.recorder
    return twin
