"""Parts of a night of long checks: command and count of each, and the pattern of the count in its output."""

import os
import re
import shlex
import sys
from dataclasses import dataclass
from typing import NamedTuple

CORES = os.cpu_count() or 1

PYTEST = "-m pytest -q -s -p no:cacheprovider"


class Share(NamedTuple):
    """Share of a part.

    Attributes:
        number: Number of the share, from 0; another number, another draw.
        first: Count that the part has completed before.
        count: Requested count of the share.
    """

    number: int
    first: float
    count: float

    def filled(self, text: str) -> str:
        """Return a text with the values of this share in the place of their names."""
        first, count = (f"{value:.12g}" for value in (self.first, self.count))
        quarter, twice = f"{-(-self.count // 4):.0f}", f"{2 * self.count:.0f}"
        # Far from the seeds of other shares.
        seeds = 1_000_000 * (self.number + 1)
        return text.format(
            first=first,
            count=count,
            quarter=quarter,
            twice=twice,
            seed=self.number + 1,
            seeds=seeds,
            cores=CORES,
        )


@dataclass(frozen=True)
class Part:
    """Part of a night.

    Attributes:
        name: Name, as in `LONG` of the Makefile.
        description: Description for the page.
        unit: Unit of its counts.
        total: Count of a whole night.
        share: Largest count of one process, and so the largest loss by an interruption.
        words: Options for Python, with names of `Share.filled`.
        count_pattern: Pattern of the count in the output; matches are added, or counted without a group.
        figures: Pattern of further lines to keep.
        progress_pattern: Pattern of the count in the output of an interrupted process; the last match counts.
        variables: Variables of its process, in the form of a shell, with names of `Share.filled`.
        alone: True if it measures times, and needs all cores.
        minimum: Smallest useful share.
    """

    name: str
    description: str
    unit: str
    total: float
    share: float
    words: str
    count_pattern: str
    figures: str = r"(?!)"
    progress_pattern: str = r"(?!)"
    variables: str = ""
    alone: bool = False
    minimum: float = 1

    def command(self, share: Share) -> list[str]:
        """Return the command of a share."""
        return [sys.executable, *shlex.split(share.filled(self.words))]

    def environment(self, share: Share) -> dict[str, str]:
        """Return the variables of a share's process."""
        return dict(pair.split("=", 1) for pair in share.filled(self.variables).split())

    def count(self, output: str) -> float:
        """Return the count in the output of a finished process."""
        counts = re.findall(self.count_pattern, output, re.MULTILINE)
        return sum(map(float, counts)) if re.compile(self.count_pattern).groups else len(counts)

    def count_under_way(self, output: str) -> float:
        """Return the last count in the output of an interrupted process."""
        counts = re.findall(self.progress_pattern, output, re.MULTILINE)
        return float(counts[-1]) if counts else 0.0

    def shown_lines(self, output: str) -> list[str]:
        """Return the lines of the output that are shown on the page."""
        return [match.group().strip() for match in re.finditer(self.figures, output, re.MULTILINE)]


def fuzz_part(name: str, description: str, total: float, share: float) -> Part:
    """Return a part that libFuzzer does, with other seeds in each share."""
    return Part(
        name,
        description,
        "inputs",
        total,
        share,
        f"-m checks {name} -runs={{count}} -seed={{seed}}",
        count_pattern=r"^Done (\d+) runs in ",
        figures=r"(?<=DONE   )cov: \d+ ft: \d+",
        progress_pattern=r"^#(\d+)\t",
    )


def files_part(kind: str, description: str, total: float) -> Part:
    """Return a part of damaged files of a kind."""
    words = f"-m checks fuzz-files {kind} {{count}} --first {{first}}"
    pattern = rf"^{kind}: (\d+) inputs"
    return Part(f"fuzz-{kind}", description, "files", total, 25_000, words, pattern, r"the slowest .*$")


def numbered_part(name: str, description: str, unit: str, total: float, share: float) -> Part:
    """Return a part whose cases have numbers."""
    words = f"-m checks {name} {{count}} --first {{first}}"
    return Part(name, description, unit, total, share, words, rf"^(\d+) {unit}[ ,]", r"\d+ findings$")


def single_run(
    name: str,
    description: str,
    words: str,
    variables: str = "",
    figures: str = r"(?!)",
    *,
    alone: bool = False,
) -> Part:
    """Return a part that runs as a whole, once."""
    pattern = r"^(?:\d+ passed|\d+ tests, \d+ failed|\d+ of \d+ mutants caught|seed \d+: \d+ of|TOTAL )"
    return Part(name, description, "runs", 1, 1, words, pattern, figures, variables=variables, alone=alone)


def kills_part(kind: str, description: str, total: float, share: float) -> Part:
    """Return a part of kills at random times."""
    words = f"-m checks kills {kind} {{count}} --jobs {{cores}} --seed {{first}}"
    pattern = rf"^{kind} killed (\d+) times"
    return Part(
        f"kills-{kind}", description, "kills", total, share, words, pattern, r"^lost by .*$", alone=True
    )


PARTS = (
    Part(
        "simulate",
        "the whole system under seeds, with faults of kernel, disk, hosts and clock",
        "simulated hours",
        1000,
        10,
        "-m checks simulate run --hours {count} --jobs 1 --first {seeds}",
        count_pattern=r"^([\d.]+) simulated hours in ",
        figures=r"^.*simulated s per s of processor time$",
        minimum=0.05,
    ),
    fuzz_part("fuzz-board", "arbitrary bytes on the robot's line", 10_000_000, 250_000),
    Part(
        "model",
        "random commands, each reply compared with a model of the board",
        "commands",
        1_000_000,
        25_000,
        f"{PYTEST} tests/board/test_board_against_model.py -k thousands",
        count_pattern=r"^\.?(\d+) commands agree",
        variables="KHEP_COMMANDS={count} KHEP_FIRST={seeds}",
    ),
    Part(
        "reconnects",
        "hosts at served lines of a Khepera and a Khepera IV, three others about; half of them over a relay",
        "reconnects",
        100_000,
        2_000,
        f"{PYTEST} tests/ports/test_random_hosts.py",
        count_pattern=r"^\.?(\d+) reconnects",
        figures=r"\d+ in doubt.*$",
        variables="KHEP_OPENINGS={quarter} KHEP_FIRST={seeds}",
    ),
    Part(
        "day",
        "serve --log with a host that never stops asking, memory watched; a day in each process",
        "simulated hours",
        72,
        24,
        "-m checks day {count} --seed {seed}",
        count_pattern=r"([\d.]+) h  [^\n]*\n(?=closed in)",
        figures=r"^.* MB more than after the first minute$",
        minimum=0.05,
    ),
    files_part("toml", "damaged playpens", 500_000),
    files_part("mat", "damaged MAT files", 100_000),
    files_part("png", "damaged PNGs", 100_000),
    files_part("picture", "damaged pictures of other formats", 200_000),
    files_part("npz", "damaged networks", 100_000),
    files_part("snapshot", "damaged snapshots of a Khepera and of Kheperas IV", 100_000),
    fuzz_part("fuzz-logs", "changed logs, read, exported and recovered", 250_000, 25_000),
    fuzz_part("fuzz-log-uses", "changed logs, viewed, repeated, branched and checked", 50_000, 5_000),
    fuzz_part("fuzz-page", "requests to the designer's page", 100_000, 10_000),
    fuzz_part("fuzz-rfc2217", "negotiations over network ports", 1_000_000, 100_000),
    numbered_part(
        "edges",
        "random playpens at the limits of the check, driven through at full speed",
        "playpens",
        2_000,
        100,
    ),
    numbered_part(
        "branches", "random logs resumed at random moments, unchanged and changed", "logs", 200, 20
    ),
    numbered_part(
        "recordings",
        "logs of sound robots with random hosts, in which conform must find nothing",
        "logs",
        300,
        50,
    ),
    single_run(
        "docs-blocks",
        "every block of the pages, the long ones as well, as a reader who copies it",
        f"{PYTEST} -n 0 tests/test_docs_blocks.py",
        "KHEP_DOCS=all",
        r"^\.?(\S+\.md, not run: .*)$",
    ),
    single_run("long-tests", "tests of the suite that are marked long", f"{PYTEST} -n 0 -m long tests"),
    single_run("pyserial", "pyserial's tests on a looped-back line", "-m checks pyserial"),
    single_run(
        "coverage",
        "lines of ports, log and host that two hours of all scenarios run",
        "-m checks simulate coverage",
        figures=r"^TOTAL .*$",
    ),
    single_run(
        "mutants",
        "broken builds, which the simulation must catch",
        "-m checks simulate mutants --jobs {cores}",
        figures=r"^\d+ of \d+ mutants .*$",
        alone=True,
    ),
    single_run(
        "faults",
        "random faults of one line in the product, which its tests must see",
        "-m checks mutants --count 100 --jobs {cores}",
        figures=r"^seed \d+: .* mutants killed$",
        alone=True,
    ),
    kills_part("serve", "served twins killed at random times, their logs recovered", 200, 50),
    kills_part("run", "runs killed at random times, their logs recovered", 40, 20),
    Part(
        "worker-kills",
        "Ray's workers killed in a sweep, each result once",
        "kills",
        100,
        100,
        "-m checks worker-kills --tasks {twice} --kills {count} --seed {seed}",
        count_pattern=r"^(\d+) workers killed in ",
        figures=r"each is there once.*$",
        alone=True,
    ),
    Part(
        "determinism",
        "100,000 steps of environments, four times: the same bit for bit",
        "steps",
        400_000,
        400_000,
        "-m checks determinism",
        count_pattern=r"^(\d+) steps, [^\n]*\n(?=(?:[^\n]*\n)*the same\n)",
        figures=r"^the same$",
        alone=True,
    ),
    Part(
        "signals",
        "signals at random moments of run, serve, design, sweep and sense",
        "signals",
        1000,
        100,
        "-m checks signals {count} --jobs {cores} --seed {first}",
        count_pattern=r"^(\d+) signals, ",
        figures=r"\d+ with faults.*$",
        alone=True,
    ),
    single_run(
        "rubbish",
        "hosts that misbehave for a minute each, and thousands that open a line",
        f"{PYTEST} tests/ports/test_chaos.py",
        "KHEP_RUBBISH_SECONDS=60 KHEP_OPENINGS=2000",
        alone=True,
    ),
    single_run(
        "leavings",
        "hosts that leave a network port; the next is served within half a second",
        f"{PYTEST} tests/ports/test_leaving_hosts.py -k stale",
        "KHEP_LEAVINGS=1000",
        r"\w+, \w+: \d+ hosts left; .*$",
        alone=True,
    ),
)
"""All parts, in the order in which they run."""
