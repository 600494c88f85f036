"""`make long`: parts accumulate over calls, counts come from outputs, findings are kept."""

import re
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from checks.__main__ import CHECKS
from checks.night import runner as night
from checks.night.page import markdown
from checks.night.parts import PARTS, Part, Share
from checks.night.runner import Night, State, rows, target_count

ROOT = Path(__file__).parents[2]
MAKEFILE = (ROOT / "Makefile").read_text()


PROLOGUE = "number, first, count = {seed} - 1, {first}, {count}; "


def part(program: str, count: float = 10, share: float = 4, alone: bool = False) -> Part:
    """A part whose processes run a line of Python, with the number and the count of their share."""
    return Part(
        "part",
        "a part",
        "things",
        count,
        share,
        f"-c {shlex.quote(PROLOGUE + program.replace('{', '{{').replace('}', '}}'))}",
        count_pattern=r"^did (\d+)$",
        figures=r"(?<=figure: ).*$",
        progress_pattern=r"^at (\d+)$",
        alone=alone,
    )


def run(part_to_run: Part, folder: Path, cores: int = 2, share: float = 1.0) -> tuple[int, State]:
    status = Night([part_to_run], share, folder, cores).run()
    return status, State(part_to_run, folder)


GOOD = 'print(f"figure: {number}"); print(f"did {count:.0f}")'


def test_a_part_is_done_in_shares_and_not_again(tmp_path: Path) -> None:
    status, state = run(part(GOOD), tmp_path)
    assert status == 0
    assert state.completed_count == 10
    assert sorted((part_run.number, part_run.count) for part_run in state.runs) == [(0, 4), (1, 4), (2, 2)]
    _, again = run(part(GOOD), tmp_path)
    assert again.runs == state.runs


def test_a_share_of_a_night_is_done_first_and_the_rest_later(tmp_path: Path) -> None:
    assert run(part(GOOD), tmp_path, share=0.25)[1].completed_count == 3
    assert run(part(GOOD), tmp_path)[1].completed_count == 10


def test_counts_come_from_the_output(tmp_path: Path) -> None:
    _, state = run(part('print(f"did {count - 1:.0f}")', count=7, share=4), tmp_path, cores=1)
    assert [part_run.count for part_run in state.runs] == [3, 3, 0]


def test_a_finding_ends_its_part_and_is_tried_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bad = part(f"import sys; number == 1 and sys.exit('what is wrong'); {GOOD}")
    status, state = run(bad, tmp_path, cores=1)
    assert status == 1
    assert state.completed_count == 4
    (finding,) = state.findings
    assert finding.finding == "what is wrong"
    assert finding.command in capsys.readouterr().out
    assert (tmp_path / "part-1.txt").read_text() == "what is wrong\n"
    status, state = run(part(GOOD), tmp_path, cores=1)
    assert (status, state.completed_count, state.findings) == (0, 10, [])


def test_an_output_without_a_count_is_a_finding(tmp_path: Path) -> None:
    status, state = run(part("print('all good')"), tmp_path, cores=1)
    assert status == 1
    assert "has no count" in state.findings[0].finding


def test_a_part_that_measures_times_runs_alone(tmp_path: Path) -> None:
    busy = tmp_path / "busy"
    alone = f"busy = pathlib.Path({str(busy)!r}); busy.mkdir(); time.sleep(0.1); busy.rmdir()"
    program = f"import pathlib, time; {alone}; {GOOD}"
    status, state = run(part(program, alone=True), tmp_path / "night", cores=4)
    assert status == 0
    assert state.completed_count == 10


def interrupted(program: str, ready: Callable[[Path], bool], folder: Path) -> State:
    """The state after a night in another process was interrupted while it ran a part."""
    script = (
        "import sys, test_night, pathlib\n"
        f"sys.exit(test_night.run(test_night.part({program!r}, 10, 10), pathlib.Path({str(folder)!r}))[0])"
    )
    environment = {"PYTHONPATH": f"{Path(__file__).parent}:{ROOT}", "PATH": "/usr/bin:/bin"}
    with subprocess.Popen([sys.executable, "-c", script], env=environment, cwd=ROOT) as process:
        end = time.monotonic() + 60
        while not ready(folder):
            assert time.monotonic() < end
            time.sleep(0.02)
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 0
    return State(part(program, 10, 10), folder)


def test_an_interruption_keeps_what_a_process_has_told(tmp_path: Path) -> None:
    program = "import time; print('at 3', flush=True); time.sleep(600)"

    def ready(folder: Path) -> bool:
        log = folder / "part-0.txt"
        return log.exists() and "at 3" in log.read_text()

    state = interrupted(program, ready, tmp_path)
    assert state.completed_count == 3
    assert state.runs[0].status is None
    assert not (tmp_path / "part-0.txt").exists()
    assert run(part(GOOD, 10, 10), tmp_path)[1].completed_count == 10


OUTPUTS = {
    "simulate": ("10.0 simulated hours in 52 s, 0 violations", 10),
    "fuzz-board": ("#7\tNEW\nDone 250000 runs in 93 second(s)", 250000),
    "model": (".25004 commands agree, seeds 0 to 9\n.\n1 passed", 25004),
    "reconnects": ("1000 reconnects, 0 in doubt\n.1000 reconnects, 1 in doubt", 2000),
    "day": ("  1.00 h  1 MB  x\n 24.00 h     84.2 MB  grown\nclosed in 0.0 s, 84.3 MB then", 24),
    "fuzz-toml": (
        "toml: 12500 inputs from 0 in 3 s, the slowest 1 ms\ntoml: 12500 inputs from 12500",
        25000,
    ),
    "kills-serve": ("serve killed 50 times, all recovered, 50 as a whole", 50),
    "kills-run": ("run killed 20 times, all recovered, 20 as a whole", 20),
    "worker-kills": ("100 workers killed in a sweep of 200 tasks", 100),
    "determinism": ("100000 steps, single: a\n100000 steps, together by 2 threads: b\nthe same\n", 200000),
    "signals": (
        "run: 20 signals, ended\n100 signals, 0 with faults, 1 during the start of the interpreter",
        100,
    ),
    "branches": ("20 logs from 0 on, 0 findings", 20),
    "edges": ("100 playpens from 300 on: 0 broke", 100),
    "recordings": ("50 logs, 0 reports with findings", 50),
    "long-tests": (".....\n5 passed, 3 skipped in 100.1s", 1),
    "pyserial": ("test 20 tests, 3 failed\n71 tests, 5 failed, 5 known to", 1),
    "mutants": ("a: replies, seed 3, 20 s, 1 faults\n74 of 74 mutants caught, with 5 faults or fewer", 1),
    "faults": ("khep_twin/a.py:3: result None, 2 tests\nseed 1: 95 of 100 mutants killed", 1),
    "coverage": ("Name  Stmts\nkhep_twin/log/a.py  10\nTOTAL   3000   300   90%", 1),
}
"""Outputs of the tools, and their counts."""


@pytest.mark.parametrize("name", OUTPUTS)
def test_the_count_of_each_tool_is_read(name: str) -> None:
    (night_part,) = (candidate for candidate in PARTS if candidate.name == name)
    output, count = OUTPUTS[name]
    assert night_part.count(output) == count


def test_an_interrupted_fuzzer_has_done_what_it_told_last() -> None:
    (parser,) = (candidate for candidate in PARTS if candidate.name == "fuzz-board")
    assert parser.count_under_way("#2\tINITED cov\n#4096\tpulse  cov: 3\n") == 4096


QUICK = ("fuzz-png", "fuzz-rfc2217")


def test_quick_parts_run_with_a_tiny_share(tmp_path: Path) -> None:
    pytest.importorskip("atheris")
    command = [sys.executable, "-m", "checks", "night", "run", *QUICK]
    command += ["--share", "0.0005", "--folder", str(tmp_path)]
    process = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, timeout=300, check=False)
    assert process.returncode == 0, process.stdout + process.stderr
    for night_part in PARTS:
        state = State(night_part, tmp_path)
        assert (state.completed_count >= target_count(night_part, 0.0005)) == (night_part.name in QUICK)
    page = (tmp_path / "page.md").read_text()
    assert page.count("nothing found so far") == len(QUICK)
    assert page.count("| not run |") == len(PARTS) - len(QUICK)


def test_parts_may_follow_the_options_as_make_gives_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["night", "list", "--folder", str(tmp_path), "fuzz-board", "nothing"]
    monkeypatch.setattr(sys, "argv", words)
    with pytest.raises(SystemExit):
        night.main()
    assert "nothing: no such part" in capsys.readouterr().err


def test_shares_of_a_part_draw_other_things() -> None:
    for night_part in PARTS:
        if night_part.total == night_part.share:  # which is one thing
            continue
        shares = [Share(number, night_part.share * number, night_part.share) for number in range(3)]
        commands = {
            (tuple(night_part.command(share)), tuple(night_part.environment(share).items()))
            for share in shares
        }
        assert len(commands) == 3, night_part.name


def test_the_page_tells_each_part_and_its_findings_as_text(tmp_path: Path) -> None:
    finding = "it broke here\n```\nDone 5 runs in 1 second(s)"
    state = State(PARTS[1], tmp_path)
    state.add(night.Run(0, 5, 5, 3.0, 1, "python x.py", "2026-01-01 00:00", "abc", [], finding))
    page_rows = rows(tmp_path)
    text = markdown(page_rows, "now")
    assert all(night_part.description in text for night_part in PARTS)
    assert text.count("```") == 2
    assert "1 finding" in text


def test_every_check_is_part_of_a_night() -> None:
    run_by = {
        night_part.command(Share(0, 0, night_part.share))[3]
        for night_part in PARTS
        if "checks" in night_part.words
    }
    assert run_by == set(CHECKS) - {"night"}


def test_the_files_that_parts_name_are_there_and_make_runs_them() -> None:
    for night_part in PARTS:
        words = night_part.command(Share(0, 0, night_part.share))
        for word in words:
            if re.fullmatch(r"tests/.*\.py", word):
                assert (ROOT / word).is_file(), word
    assert "-m checks night run --share $(LONG_SHARE) $(LONG)" in MAKEFILE
