"""Trials of the shadow: a share of `python -m studies twin-trials`, and how they judge."""

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from khep_twin.log.shadow_channels import PoseState
from khep_twin.shadow.actions import ProximityReply
from khep_twin.shadow.persistence import MIN_NOVELTY
from khep_twin.shadow.shadow import ShadowSettings
from stand_ins.hosts import TUNING_HOSTS
from stand_ins.recordings import Truth
from studies import fault_recordings, twin_trials
from studies.fault_bounds import gap, posterior
from studies.fault_oracle import Explanation, new_parts
from studies.fault_trials import add_similar_names, judge
from studies.healthy_trials import ALL, healthy_cells, healthy_recordings, inside, run_healthy
from studies.reliability import Claim, bin_claims, claims, draw
from studies.twin_runs import AlarmRecord, Recording, ShadowRun, SuspicionRecord

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
def test_poses_are_nearer_than_those_of_dead_reckoning(printed: Table) -> None:
    rows = printed("pose", "--playpen", "obstacles", "--seconds", "20", "--first", "1")
    assert [row["asks"] for row in rows] == ["N, D", "N, H, D"]
    for row in rows:
        assert (row["playpen"], row["runs"]) == ("obstacles", "1")
        assert 0 < float(row["median"]) < 10
        assert float(row["median"]) < float(row["reckoned"]) < 200


@pytest.mark.long
def test_a_dead_sensor_is_named(printed: Table, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("BEGINS_S", (5.0, 6.0)), ("LASTS_S", 8.0), ("AFTER_S", 4.0)):
        monkeypatch.setattr(fault_recordings, name, value)
    (row,) = printed("alarms", "--fault", "dead sensor", "--first", "11")
    assert (row["fault"], row["runs"], row["named in 3 s"]) == ("dead sensor", "1", "1")
    assert row["ended in 5 s"] == "1 of 1"
    assert row["wrong names"] == ""


@pytest.mark.long
def test_an_oracle_names_a_dead_motor_and_a_lift(printed: Table, monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in (("BEGINS_S", (5.0, 6.0)), ("LASTS_S", 8.0), ("AFTER_S", 4.0)):
        monkeypatch.setattr(fault_recordings, name, value)
    faults = "dead motor", "dead sensor", "robot lifted"
    rows = printed("bounds", *(word for fault in faults for word in ("--fault", fault)), "--first", "521")
    assert [row["fault"] for row in rows] == ["dead motor", "robot lifted"]
    for row in rows:
        assert (row["runs"], row["right name sure"], row["or alike"]) == ("1", "1", "1")
        assert float(row["lowest"]) > 10


def truth() -> Truth:
    """A sensor that is dead from 10 s to 30 s, which shows from 12 s on."""
    none, times = np.zeros((0, 3)), np.zeros(0, np.int64)
    changed_ns, ended_ns, noticeable_ns = (np.array([time_s * SECOND]) for time_s in (10, 30, 12))
    return Truth(times, none, none, none, np.array(["dead:2"]), changed_ns, ended_ns, noticeable_ns, ended_ns)


def raised(fault: str, raised_s: float, ended_s: float = -1, reading: float = 0) -> AlarmRecord:
    ended_ns = -1 if ended_s < 0 else round(ended_s * SECOND)
    return AlarmRecord(fault, round(raised_s * SECOND), ended_ns, (reading,) * 8)


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
    alarms: list[AlarmRecord], named: bool, delay_s: float | None, wrong: tuple[str, ...], end_s: float | None
) -> None:
    judgement = judge(("dead sensor 2",), truth(), 30 * SECOND, alarms)
    assert (judgement.named, judgement.wrong) == (named, wrong)
    assert judgement.delay_s == pytest.approx(np.nan if delay_s is None else delay_s, nan_ok=True)
    assert judgement.end_s == pytest.approx(np.nan if end_s is None else end_s, nan_ok=True)


@pytest.mark.parametrize(("reading", "named"), [(0, True), (300, False)])
def test_a_stuck_sensor_may_be_called_dead_while_it_reads_0(reading: float, named: bool) -> None:
    names = "stuck sensor 2", "dead sensor 2"
    judgement = judge(names, truth(), 30 * SECOND, [raised("dead sensor 2", 13, 31, reading)])
    assert judgement.named == named


def test_an_alarm_of_a_fault_that_looks_alike_is_a_pair_in_time_and_false_later() -> None:
    alarms = [raised("slipping wheel left", 14, 31), raised("weak motor left", 40)]
    suspected = [SuspicionRecord(("weak motor left", "slipping wheel left"), 13 * SECOND, 0.96, (0.0,) * 8)]
    judgement = judge(("weak motor left",), truth(), 30 * SECOND, alarms, suspected)
    assert (judgement.named, judgement.paired) == (False, True)
    assert not judge(("weak motor left",), truth(), 30 * SECOND, [], suspected).paired
    # One that is raised ten seconds after the fault's end is false.
    assert [claim.right for claim in judgement.claims] == [False, False, True]


def test_faults_of_the_same_wheel_look_alike() -> None:
    left = {"weak motor left", "slipping wheel left", "dead motor or blocked wheel left"}
    assert add_similar_names(["weak motor left"]) == left
    assert add_similar_names(["moved block1"]) == {"moved block1", "missing block1"}
    assert add_similar_names(["robot lifted"]) == {"robot lifted"}


@pytest.mark.parametrize(
    ("fault", "is_right"),
    [
        ("dead motor or blocked wheel left", True),
        ("dead motor or blocked wheel left or weak motor left", True),
        ("weak motor left or slipping wheel left", False),
        ("dead motor or blocked wheel right", False),
    ],
)
def test_an_alarm_of_several_names_is_right_if_one_of_them_is(fault: str, is_right: bool) -> None:
    judgement = judge(("dead motor or blocked wheel left",), truth(), 30 * SECOND, [raised(fault, 14)])
    assert [claim.right for claim in judgement.claims] == [is_right]


def test_a_bound_is_the_probability_of_a_name_and_its_distance_from_the_best_other_one() -> None:
    explanations = [
        Explanation("sound", 0, -20),
        Explanation("weak motor left", -2, -7),
        Explanation("slipping wheel left", -3, -8),
    ]
    assert gap(explanations, "weak motor left") == 1
    assert gap(explanations, "sound") == -13
    assert gap(explanations, "missing block0") == -np.inf
    odds = np.exp([-20, -9, -11])
    chances = posterior(explanations)
    assert list(chances) == ["sound", "weak motor left", "slipping wheel left"]
    assert list(chances.values()) == pytest.approx(odds / odds.sum())
    # Far below what a number can hold, only differences count.
    far = [explanation._replace(evidence=explanation.evidence - 1e4) for explanation in explanations]
    assert posterior(far) == pytest.approx(chances)


def test_a_reply_is_as_new_as_the_robot_has_moved() -> None:
    times = np.arange(0, 3 * SECOND, SECOND // 50)
    poses = np.zeros((len(times), 3))
    poses[:, 0] = 0.05 * np.clip(times / SECOND - 1, 0, 1)  # It drives from 1 to 2 s.
    none = np.zeros(0, np.int64)
    recorded_truth = Truth(times, poses, poses[0], poses[0], np.zeros(0, np.str_), none, none, none, none)
    replies = [
        ProximityReply(round(time_s * SECOND), np.zeros(8, np.int64))
        for time_s in (0.5, 1, 1.02, 1.9, 2.5, 2.9)
    ]
    first, standing, slow, far, _, stopped = new_parts(recorded_truth, replies).values()
    assert [first, standing, stopped] == pytest.approx([MIN_NOVELTY] * 3)
    assert MIN_NOVELTY < slow < 0.2 < 0.8 < far < 1


def test_said_and_true_are_compared_in_bins(tmp_path: Path) -> None:
    alarm = raised("dead sensor 2", 13)._replace(sureness=0.97)
    names = ("dead sensor 2",)
    suspected = [
        SuspicionRecord(names, round(at_s * SECOND), probability, ())
        for at_s, probability in ((11, 0.5), (13, 0.66))
    ]
    all_claims = claims([alarm], suspected, lambda fault, time_ns, _: time_ns > 12 * SECOND)
    assert all_claims == [Claim(0.97, True, True), Claim(0.5, False, False), Claim(0.66, False, True)]
    low, _, high = bin_claims([*all_claims, *[Claim(0.98, True, False)] * 3])
    assert (low.alarms, low.suspicions, low.true) == (0, 1, 0)
    assert (high.low, high.alarms, high.true) == (0.95, 4, 0.25)
    assert high.interval[0] < 0.25 < high.interval[1]
    draw([low, high], tmp_path / "picture.png")
    assert (tmp_path / "picture.png").stat().st_size > 1000


def test_healthy_recordings_meet_all_playpens_with_all_hosts_and_starts() -> None:
    for hosts in (TUNING_HOSTS, TUNING_HOSTS[:2], TUNING_HOSTS[:1]):
        runs = 2 * len(ALL) * len(hosts)
        recordings = healthy_recordings(ALL, hosts, 0, runs, 10, "exact")
        assert (
            len({(recording.playpen, recording.host, recording.default_start) for recording in recordings})
            == runs
        )


def test_truth_is_inside_a_region_as_often_as_in_a_gaussian() -> None:
    rng, scale = np.random.default_rng(0), np.array([0.002, 0.004, 0.1])
    off = rng.normal(size=(20000, 3)) * scale
    covariances = np.tile(np.diag(scale**2), (len(off), 1, 1))
    times = np.zeros(len(off), np.int64)
    states = np.full(len(off), str(PoseState.FOLLOWED))
    actual = np.tile((0, 0, 2 * np.pi), (len(off), 1))
    followed = ShadowRun(truth(), times, off, actual, off, covariances, states, off, [], [], np.zeros(1))
    assert inside(followed).mean(axis=0) == pytest.approx(0.95, abs=0.005)


def test_a_healthy_robot_is_followed_without_an_alarm(tmp_path: Path) -> None:
    pytest.importorskip("numba", reason="numba is not installed")
    recording = Recording("healthy", "obstacles", 1, 5, "wall follower", times="busy")
    healthy = run_healthy(recording, tmp_path, ShadowSettings(particles=100))
    hours, alarms, _, followed, *_ = healthy_cells([healthy])
    assert (hours, alarms, followed) == ("0.00", "0", "100.0 %")
    assert np.median(healthy.errors_mm) < 10
    assert healthy.text.startswith("obstacles, wall follower, seed 1, known start: ")
    assert healthy.rows == {"obstacles", "wall follower", "known start", "in reach each 30 s", "all"}
