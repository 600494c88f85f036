"""Trials of the shadow: a share of `python -m studies twin-trials`, and how they judge."""

import sys
from collections.abc import Callable

import numpy as np
import pytest

from stand_ins.recordings import Truth
from studies import fault_trials, twin_trials
from studies.fault_trials import judge
from studies.twin_runs import Raised

SECOND = 1_000_000_000

Table = Callable[..., list[dict[str, str]]]


@pytest.fixture
def printed(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Table:
    """A function that runs trials of few particles, and returns the rows of their table by its head."""
    pytest.importorskip("numba", reason="numba is not installed")

    def run(*words: str) -> list[dict[str, str]]:
        monkeypatch.setattr(sys, "argv", ["twin_trials", *words, "--runs", "1", "--particles", "300"])
        twin_trials.main()
        lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("|")]
        head, _, *rows = ([cell.strip() for cell in line.strip("|").split("|")] for line in lines)
        return [dict(zip(head, row, strict=True)) for row in rows]

    return run


@pytest.mark.long
def test_poses_are_nearer_than_those_of_dead_reckoning(
    printed: Table, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(twin_trials, "POSE", ("obstacles",))
    rows = printed("pose", "--seconds", "20", "--first", "1")
    assert [row["asks"] for row in rows] == ["N, D", "N, H, D"]
    for row in rows:
        assert (row["playpen"], row["runs"]) == ("obstacles", "1")
        assert 0 < float(row["median"]) < 10
        assert float(row["median"]) < float(row["reckoned"]) < 200


@pytest.mark.long
def test_a_dead_sensor_is_named(printed: Table, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("BEGINS_S", (5.0, 6.0)), ("LASTS_S", 8.0), ("AFTER_S", 4.0)):
        monkeypatch.setattr(fault_trials, name, value)
    (row,) = printed("alarms", "--fault", "dead sensor", "--first", "6")
    assert (row["fault"], row["runs"], row["named in 3 s"]) == ("dead sensor", "1", "1")
    assert row["ended"] == "1 of 1"
    assert row["wrong names"] == ""


def truth() -> Truth:
    """A sensor that is dead from 10 s to 30 s, which shows from 12 s on."""
    none, times = np.zeros((0, 3)), np.zeros(0, np.int64)
    changed_ns, ended_ns, noticeable_ns = (np.array([time_s * SECOND]) for time_s in (10, 30, 12))
    return Truth(times, none, none, none, np.array(["dead:2"]), changed_ns, ended_ns, noticeable_ns)


def raised(fault: str, raised_s: float, ended_s: float = -1, reading: float = 0) -> Raised:
    ended_ns = -1 if ended_s < 0 else round(ended_s * SECOND)
    return Raised(fault, round(raised_s * SECOND), ended_ns, (reading,) * 8)


@pytest.mark.parametrize(
    ("alarms", "named", "delay_s", "wrong", "end_s"),
    [
        ([raised("dead sensor 2", 13, 31)], True, 1, (), 1),
        ([raised("dead sensor 2", 11, 29)], True, -1, (), 0),
        ([raised("dead sensor 2", 16, 31)], False, 4, (), 1),
        ([raised("dead sensor 2", 9, 31)], False, None, ("dead sensor 2",), None),
        ([raised("dead sensor 2", 13)], True, 1, (), None),
        ([raised("dead sensor 3", 13, 31)], False, None, ("dead sensor 3",), None),
        (
            [raised("missing block0", 12, 13), raised("dead sensor 2", 14, 31)],
            True,
            2,
            ("missing block0",),
            1,
        ),
        ([], False, None, (), None),
    ],
    ids=["right", "early", "late", "before", "lasting", "other", "both", "none"],
)
def test_a_fault_is_named_if_a_right_name_comes_in_time(
    alarms: list[Raised], named: bool, delay_s: float | None, wrong: tuple[str, ...], end_s: float | None
) -> None:
    found = judge(("dead sensor 2",), truth(), 30 * SECOND, alarms)
    assert (found.named, found.wrong) == (named, wrong)
    assert found.delay_s == pytest.approx(np.nan if delay_s is None else delay_s, nan_ok=True)
    assert found.end_s == pytest.approx(np.nan if end_s is None else end_s, nan_ok=True)


@pytest.mark.parametrize(("reading", "named"), [(0, True), (300, False)])
def test_a_stuck_sensor_may_be_called_dead_while_it_reads_0(reading: float, named: bool) -> None:
    names = "stuck sensor 2", "dead sensor 2"
    found = judge(names, truth(), 30 * SECOND, [raised("dead sensor 2", 13, 31, reading)])
    assert found.named == named
