"""Parts of a night of long checks: what each runs, how many, and where its output says how many it was."""

import os
import re
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

Words = tuple[str, ...]

CORES = os.cpu_count() or 1
CHECKS = ("-m", "checks")


@dataclass(frozen=True)
class Share:
    """Share of a part.

    Attributes:
        number: Number of the share, from 0; another number, another draw.
        first: Count of what the part has done before.
        count: Count that is wanted of it.
    """

    number: int
    first: float
    count: float


@dataclass(frozen=True)
class Part:
    """Part of a night.

    Attributes:
        name: Name, as `LONG` of the Makefile has it.
        what: Description for the page.
        unit: Unit of its counts.
        wanted: Count of a whole night.
        share: Largest count of one process, which is what an interruption loses at most.
        words: Function of a share that returns the command, without the interpreter.
        done: Pattern of the count in the output; all that are found are added.
        figures: Pattern of further lines to keep.
        under_way: Pattern of the count in the output of an interrupted process; the last counts.
        environment: Function of a share that returns variables of its process.
        alone: True if it measures times, and needs all cores.
        least: Smallest share that makes sense.
    """

    name: str
    what: str
    unit: str
    wanted: float
    share: float
    words: Callable[[Share], Words]
    done: str
    figures: str = r"(?!)"
    under_way: str = r"(?!)"
    environment: Callable[[Share], Mapping[str, str]] = field(default=lambda share: {})
    alone: bool = False
    least: float = 1

    def command(self, share: Share) -> list[str]:
        """Return the command of a share."""
        return [sys.executable, *self.words(share)]

    def count(self, output: str) -> float:
        """Return the count that a finished process has told."""
        return sum(float(found) for found in re.findall(self.done, output, re.MULTILINE))

    def count_under_way(self, output: str) -> float:
        """Return the count that an interrupted process had told."""
        told = re.findall(self.under_way, output, re.MULTILINE)
        return float(told[-1]) if told else 0.0

    def kept(self, output: str) -> list[str]:
        """Return the lines of the output that are shown on the page."""
        return [found.group().strip() for found in re.finditer(self.figures, output, re.MULTILINE)]


def fuzzed(name: str, what: str, tool: str, wanted: float, share: float) -> Part:
    """Return a part that libFuzzer does, with other seeds in each share."""
    return Part(
        name,
        what,
        "inputs",
        wanted,
        share,
        lambda share: (*CHECKS, f"fuzz-{tool}", f"-runs={share.count:.0f}", f"-seed={share.number + 1}"),
        done=r"^Done (\d+) runs in ",
        figures=r"(?<=DONE   )cov: \d+ ft: \d+",
        under_way=r"^#(\d+)\t",
    )


def files(kind: str, what: str, wanted: float) -> Part:
    """Return a part of damaged files of a kind."""
    return Part(
        f"files-{kind}",
        what,
        "files",
        wanted,
        25_000,
        lambda share: (*CHECKS, "fuzz-files", kind, f"{share.count:.0f}", "--first", f"{share.first:.0f}"),
        done=rf"^{kind}: (\d+) inputs",
        figures=r"the slowest .*$",
    )


def tested(path: str) -> Callable[[Share], Words]:
    """Return a command that runs a file of tests, whose output is not hidden."""
    return lambda share: ("-m", "pytest", "-q", "-s", "-p", "no:cacheprovider", *path.split())


def ids(share: Share) -> str:
    """Return the first seed of a share, far from those of the others."""
    return str(1_000_000 * (share.number + 1))


PARTS = (
    Part(
        "simulation",
        "the whole system under seeds, with faults of kernel, disk, hosts and clock",
        "simulated hours",
        1000,
        10,
        lambda share: (
            *(*CHECKS, "simulate", "run", "--hours", f"{share.count:g}", "--jobs", "1"),
            *("--first", ids(share)),
        ),
        done=r"^([\d.]+) simulated hours in ",
        figures=r"^.*simulated s per s of processor time$",
        least=0.05,
    ),
    fuzzed("parser", "arbitrary bytes on the robot's line", "board", 10_000_000, 250_000),
    Part(
        "model",
        "random commands, each reply compared with a model of the board",
        "commands",
        1_000_000,
        25_000,
        tested("tests/board/test_board_against_model.py -k thousands"),
        done=r"^\.?(\d+) commands agree",
        environment=lambda share: {"KHEP_COMMANDS": f"{share.count:.0f}", "KHEP_FIRST": ids(share)},
    ),
    Part(
        "reconnects",
        "hosts that open and close a served line, three others about; half of them over a relay",
        "reconnects",
        100_000,
        2_000,
        tested("tests/ports/test_random_hosts.py"),
        done=r"^\.?(\d+) reconnects",
        figures=r"\d+ in doubt.*$",
        environment=lambda share: {"KHEP_OPENINGS": f"{-(-share.count // 2):.0f}", "KHEP_FIRST": ids(share)},
    ),
    Part(
        "soak",
        "serve --log with a host that never stops asking, memory watched; a day in each process",
        "simulated hours",
        72,
        24,
        lambda share: (*CHECKS, "day", f"{share.count:g}", "--seed", str(share.number + 1)),
        done=r"([\d.]+) h  [^\n]*\n(?=closed in)",
        figures=r"^.* MB more than after the first minute$",
        least=0.05,
    ),
    files("toml", "damaged playpens", 500_000),
    files("mat", "damaged MAT files", 100_000),
    files("png", "damaged PNGs", 100_000),
    fuzzed("logs", "changed logs, read, exported and recovered", "logs", 250_000, 25_000),
    fuzzed(
        "log-uses",
        "changed logs, viewed, repeated, branched and checked",
        "log-uses",
        50_000,
        5_000,
    ),
    fuzzed("page", "requests to the designer's page", "page", 100_000, 10_000),
    fuzzed("rfc2217", "negotiations over network ports", "rfc2217", 1_000_000, 100_000),
    Part(
        "kills",
        "served twins killed at random times, their logs recovered",
        "kills",
        200,
        50,
        lambda share: (
            *(*CHECKS, "kills", "serve", f"{share.count:.0f}"),
            *("--jobs", str(CORES), "--seed", f"{share.first:.0f}"),
        ),
        done=r"^serve killed (\d+) times",
        figures=r"^lost by .*$",
        alone=True,
    ),
    Part(
        "run-kills",
        "runs killed at random times, their logs recovered",
        "kills",
        40,
        20,
        lambda share: (
            *(*CHECKS, "kills", "run", f"{share.count:.0f}"),
            *("--jobs", str(CORES), "--seed", f"{share.first:.0f}"),
        ),
        done=r"^run killed (\d+) times",
        figures=r"^lost by .*$",
        alone=True,
    ),
    Part(
        "worker-kills",
        "Ray's workers killed in a sweep, each result once",
        "kills",
        100,
        100,
        lambda share: (
            *(*CHECKS, "worker-kills", "--tasks", f"{2 * share.count:.0f}"),
            *("--kills", f"{share.count:.0f}", "--seed", str(share.number)),
        ),
        done=r"^(\d+) workers killed in ",
        figures=r"each is there once.*$",
        alone=True,
    ),
    Part(
        "determinism",
        "100,000 steps of environments, four times: the same bit for bit",
        "steps",
        400_000,
        400_000,
        lambda share: (*CHECKS, "determinism"),
        done=r"^(\d+) steps, [^\n]*\n(?=(?:[^\n]*\n)*the same\n)",
        figures=r"^the same$",
        alone=True,
    ),
    Part(
        "signals",
        "signals at random moments of run, serve, design, sweep and sense",
        "signals",
        1000,
        100,
        lambda share: (
            *(*CHECKS, "signals", f"{share.count:.0f}"),
            *("--jobs", str(CORES), "--seed", f"{share.first:.0f}"),
        ),
        done=r"^(\d+) signals, ",
        figures=r"\d+ with faults.*$",
        alone=True,
    ),
    Part(
        "branches",
        "random logs resumed at random moments, unchanged and changed",
        "logs",
        200,
        20,
        lambda share: (*CHECKS, "branches", f"{share.count:.0f}", "--first", f"{share.first:.0f}"),
        done=r"^(\d+) logs from ",
        figures=r"\d+ findings$",
    ),
)
"""All parts, in the order in which they run."""
