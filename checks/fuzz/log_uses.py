"""A fuzz target: changed logs that are viewed, played, reported on, repeated, branched, checked and followed.

    python -m checks fuzz-log-uses -runs=5000         with atheris (libFuzzer)

The recipes are those of `fuzz_logs`, of a log with all its attachments, so that its world can be opened: a
tenth of a second in a small playpen. With `IN_TEXT` in the first byte, the first step of six bytes replaces
a word of an attachment: its number, the number of the word, and the number of the new one. `check` has the
conditions. rerun keeps 4 MB of each log that it has read (measured), so that a process takes some thousand
inputs.
"""

import re
import struct
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path

from mcap.opcode import Opcode

from checks.fuzz.libfuzzer import fuzz
from checks.fuzz.log_mutations import Record, parse_records
from checks.fuzz.logs import KHEPERA4, ODD, STEP, cooked, error_text, folder, playpen_of, write_steps

MODULES = (
    "khep_twin.log.viewer.replay",
    "khep_twin.log.viewer.collected",
    "khep_twin.log.viewer.ghost",
    "khep_twin.log.viewer.thinning",
    "khep_twin.log.attached",
    "khep_twin.log.description",
    "khep_twin.log.recorded",
    "khep_twin.log.snapshots",
    "khep_twin.ports.replay",
    "khep_twin.ports.resume",
    "khep_twin.ports.branching",
    "khep_twin.lab.conformance.recording.conform",
    "khep_twin.lab.experiment.repeat",
    "khep_twin.lab.experiment.branch",
    "khep_twin.lab.report.report",
    "khep_twin.shadow.recording",
    "khep_twin.log.transforms",
    "khep_twin.web.run_content",
    "khep_twin.robots.khepera4",
    "khep_twin.simulation.number_reader",
    "khep_twin.simulation.snapshot_format",
)
"""Modules whose branches libFuzzer looks for."""

IN_TEXT = 0x40
"""Bit of the first byte: the first step is about an attachment's text."""

WORD = re.compile(rb"-?[0-9.]+(?:e-?[0-9]+)?|[A-Za-z_]+")

WORDS = [
    *(b"%d" % value for value in ODD),
    *(b"nan inf -inf 1e308 -1e308 1e-308 0.5 1e999 NaN Infinity true null [] {} [[]]".split()),
    *(b"9" * 5000, b"<body/>", b"<include file='/etc/passwd'/>", b"]]>", b"\0", b"\xff", b'"', b"\n", b""),
    *(b"khepera2 khepera4 gripper k213 radio 6.05 box sphere plane mesh replicate file xml".split()),
    *(b"robot block lamp".split()),
]
"""Words that are put into texts."""


@cache
def records(playpen: str = "default") -> tuple[Record, ...]:
    """Return the records of a log of seven samples, with a movement."""
    from khep_twin.ports.twin import TwinOptions, open_twin

    path = folder() / "base.mcap"
    path.unlink(missing_ok=True)
    with open_twin(playpen, TwinOptions(log=str(path))) as twin:
        twin.robot.send(b"N\nD,5,5\n" if playpen == "default" else b"D,50,50\r\n")
        twin.advance_to(120_000_000)
        twin.world.log_event(0, "x")
    return tuple(parse_records(path.read_bytes()))


def changed_text(record: Record, which: int, word: bytes) -> Record:
    """Return an attachment with one of its words replaced."""
    (name,) = struct.unpack_from("<I", record.content, 16)
    (kind,) = struct.unpack_from("<I", record.content, 20 + name)
    start = 24 + name + kind
    text = record.content[start + 8 : -4]
    words = list(WORD.finditer(text))
    if words:
        match = words[which % len(words)]
        text = text[: match.start()] + word + text[match.end() :]
    return replace(record, content=record.content[:start] + struct.pack("<Q", len(text)) + text + bytes(4))


def log_of(data: bytes) -> bytes:
    """Return the log of a recipe."""
    first = records(playpen_of(data))
    if data and data[0] & IN_TEXT and len(data) > STEP:
        attachment, which, word, _ = struct.unpack("<BHHB", data[1 : 1 + STEP])
        places = [index for index, record in enumerate(first) if record.opcode == Opcode.ATTACHMENT]
        place = places[attachment % len(places)]
        other = changed_text(first[place], which, WORDS[word % len(WORDS)])
        first = (*first[:place], other, *first[place + 1 :])
        data = data[:1] + data[1 + STEP :]
    return cooked(data, first)


def check(data: bytes) -> None:
    """Use one log as commands do.

    Raises:
        AssertionError: An error has several lines, or a use left files behind.
        Exception: Any error that is no KhepTwinError is a finding.
    """
    path = folder() / "x.mcap"
    path.write_bytes(log_of(data))
    use = USES[(data[0] if data else 0) % KHEPERA4 % len(USES)]
    line = error_text(use, path)
    assert line.isprintable(), line
    rest = {file.name for file in folder().iterdir()} - {"x.mcap", "base.mcap"}
    assert not rest, rest


def view(path: Path) -> None:
    """Convert a log for the viewer, as `khep-twin view` does before it opens one."""
    from khep_twin.log.viewer import replay

    recording = path.with_suffix(".rrd")
    try:
        replay.view([path], recording)
        assert recording.stat().st_size
    finally:
        recording.unlink(missing_ok=True)


def report(path: Path) -> None:
    """Make the contents of a report on a log."""
    from khep_twin.lab.report.report import make_report as report_on
    from khep_twin.log.reader import read_series
    from khep_twin.log.shadow_channels import is_shadow
    from khep_twin.log.shadow_track import read_shadow

    recording = read_series(path)
    # Its figures take half a second.
    report_on(recording, str(path), read_shadow(path) if is_shadow(recording.label) else None)


def page(path: Path) -> None:
    """Make the page that plays a log; none of its texts is a script there."""
    from khep_twin.web.run_page import RunPage

    assert RunPage([path]).html.count("<script>") == 1


def repeat(path: Path) -> None:
    """Repeat a log's run."""
    from khep_twin.lab.experiment.repeat import repeat as run_again
    from khep_twin.log.recorded import read_recorded_run

    run_again(read_recorded_run(path))


def branch_same(path: Path) -> None:
    """Take a run up with nothing changed, to its end."""
    _branch(path, seed=None)


def branch_changed(path: Path) -> None:
    """Resume a run with another seed."""
    _branch(path, seed=3)


def _branch(path: Path, seed: int | None) -> None:
    from khep_twin.lab.experiment.branch import BranchPlan, branch
    from khep_twin.log.recorded import BranchPoint

    output = path.with_name("branch.mcap")
    try:
        branch(BranchPlan(path, BranchPoint(60_000_000, seed=seed), seconds=0.05), output)
    finally:
        for file in (output, path.with_name("branch.mcap.part")):
            file.unlink(missing_ok=True)


def conform(path: Path) -> None:
    """Check the protocol in a log."""
    from khep_twin.lab.conformance.recording.conform import conform_recording

    conformance = conform_recording(path)
    conformance.text()
    conformance.json()


def follow(path: Path) -> None:
    """Read a log as `khep-twin shadow` does."""
    from khep_twin.shadow.recording import read_recording

    read_recording(path)


USES: list[Callable[[Path], None]] = [
    *(view, repeat, branch_same, branch_changed, conform, report, follow, page)
]
"""Uses of a log, chosen by the first byte."""


def seeds(target: Path) -> None:
    """Write seed inputs: each use, each kind of step, and words of each attachment."""
    write_steps(target, len(USES))
    for use in [robot | use for robot in (0, KHEPERA4) for use in range(len(USES))]:
        for kind in range(0, 256, 24):
            text = struct.pack("<BHHB", kind // 24, 7 * kind, kind, 0)
            (target / f"text{use}-{kind}").write_bytes(bytes([use | IN_TEXT]) + text)


def main() -> None:
    """Run libFuzzer with options of the command line."""
    folder()
    records()
    records("arena4")
    fuzz(check, seeds, MODULES, "-max_len=61", "-len_control=0", "-rss_limit_mb=6000")
