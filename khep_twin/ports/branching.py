"""Branches of logged runs, with a log that starts with the records of the old one, and with other hosts."""

import warnings
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from khep_twin.clock import NS_PER_S
from khep_twin.errors import LogError, PortError
from khep_twin.files.atomic import is_same
from khep_twin.files.text import escape_surrogates
from khep_twin.log.entries import Label
from khep_twin.log.reader import hash_file, read_end_ns, read_label
from khep_twin.log.recorded import BRANCH, BranchPoint, changes_text, read_changes
from khep_twin.log.run_description import LogPrefix, version_differences, versions
from khep_twin.ports.resume import ResumedRun, resume_run
from khep_twin.ports.twin import Twin
from khep_twin.units import STEP_NS


class LogDetails(NamedTuple):
    """Additional facts and attachments of a log."""

    facts: Mapping[str, str] = {}
    attachments: Mapping[str, str] = {}


_NO_DETAILS = LogDetails()


def branch_off(
    path: Path,
    change: BranchPoint,
    log: Path | None = None,
    details: LogDetails = _NO_DETAILS,
    on_failure: Callable[[str], None] | None = None,
    *,
    is_unchanged: bool = False,
) -> ResumedRun:
    """Resume the run of a log with a change; the recorded hosts continue.

    Args:
        path: Path of the log.
        change: Time of the branch and the values that change.
        log: Path of a new log, which starts with the records of the old one; None for none.
        details: Additional facts and attachments of the new log.
        on_failure: Function called with the message if writing the log fails; None to raise instead.
        is_unchanged: True if no value changes; the recorded run then continues with its later changes.

    Raises:
        LogError: The log lacks necessary records, or the new one cannot be written.
        KhepTwinError: The change cannot be made.
    """
    end_ns = read_end_ns(path)
    if not end_ns:
        raise LogError(f"{path}: the run ends at 0 s; expected a longer run, to resume it")
    if not 0 < change.at_ns <= end_ns:
        problem = f"{path}: the run cannot be resumed at {change.at_ns / NS_PER_S:g} s"
        raise LogError(f"{problem}; expected above 0 and up to its end at {end_ns / NS_PER_S:g} s")
    for difference in version_differences(read_label(path)):
        warnings.warn(f"{path}: {difference}; the run may differ from the recorded one", stacklevel=2)
    if log is not None and is_same(log, path):
        raise LogError(f"{log}: this is the log that is resumed; expected a separate file")
    twins: list[Twin] = []

    def start_log(twin: Twin, label: Label, prefix: LogPrefix) -> None:
        branch = replace(change, parent=escape_surrogates(path.name), sha256=hash_file(path))
        facts = {
            **label.metadata,
            **versions(),
            **details.facts,
            "parent": branch.parent,
            "parent_sha256": branch.sha256,
            "branched_at_s": f"{branch.at_ns / NS_PER_S:.9g}",
        }
        earlier = [other for other in read_changes(path, label) if other.at_ns < branch.at_ns]
        later = [other for other in read_changes(path, label) if is_unchanged and other.at_ns >= branch.at_ns]
        changes_json = changes_text([*earlier, branch, *later])
        attachments = {**label.attachments, BRANCH: changes_json, **details.attachments}
        twins.append(twin)
        if log is not None:
            twin.record(log, facts=facts, attachments=attachments, prefix=prefix, on_failure=on_failure)

    try:
        # An unchanged run need not stop within a step.
        resume_ns = change.at_ns // STEP_NS * STEP_NS if is_unchanged else change.at_ns
        resumed = resume_run(path, resume_ns, None if log is None else start_log)
        if not is_unchanged:
            resumed.upcoming.clear()
            resumed.change(change)
    except BaseException:
        for recorder in filter(None, [twin.recorder for twin in twins]):
            recorder.discard()
        raise
    resumed.twin.branched_at_ns = resumed.twin.world.time_ns
    return resumed


def open_log(
    path: Path,
    change: BranchPoint,
    robot: int | None,
    log: Path | None = None,
    *,
    all_robots: bool = False,
    on_failure: Callable[[str], None] | None = None,
) -> Twin:
    """Resume the run of a log for other hosts, as `branch_off` does.

    The robot with this index is on the line; with None that of the log, or all robots if `all_robots`.

    Raises:
        KhepTwinError: As in `branch_off`, or the run has no robot with this index.
    """
    resumed = branch_off(path, change, log, on_failure=on_failure)
    all_indices = range(len(resumed.twin.world.robots))
    if robot is None and not all_robots:
        robot = resumed.setup.options.robot or 0
    if robot is not None and robot not in all_indices:
        if resumed.twin.recorder is not None:
            resumed.twin.recorder.discard()
        raise PortError(f"robot = {robot}: not in {path}", key="robot", value=robot, expected=all_indices)
    indices = all_indices if robot is None else [robot]
    for index in indices:
        resumed.hosts.drop_host(index)
    world, options = resumed.twin.world, resumed.twin.options
    twin = Twin(world, tuple(world.robots[index] for index in indices), options, resumed.hosts)
    twin.recorder = resumed.twin.recorder
    return twin
