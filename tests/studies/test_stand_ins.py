"""Stand-in robots: recordings as a relay makes them, hidden changes, and when these are noticeable."""

import json
from pathlib import Path

import numpy as np
import pytest

from khep_twin.log.reader import read_series
from khep_twin.playpen import Cylinder, Playpen
from khep_twin.randomness import stream
from khep_twin.units import BITS_PER_BYTE
from khep_twin.world import World
from stand_ins.hidden_changes import Added, Lifted, Moved, Removed, apply, hide_added, with_added
from stand_ins.hosts import FIRST_TEST_SEED, TEST_HOSTS, hosts_of
from stand_ins.line_times import PACKET_NS, STALL_EVERY_NS, STALL_NS, LineTimes
from stand_ins.recordings import Truth, record

PLAYPEN = Playpen.load("workshop")
CAN = Cylinder(x_mm=345, y_mm=190, radius_mm=15, height_mm=50)


def looking(playpen: Playpen) -> World:
    return World(playpen, noise=False, compiled=True)


def test_a_seed_for_tuning_has_no_host_that_is_kept_apart() -> None:
    assert not set(TEST_HOSTS) & set(hosts_of(FIRST_TEST_SEED - 1))
    assert set(TEST_HOSTS) < set(hosts_of(FIRST_TEST_SEED))


def test_a_busy_relay_passes_on_together_what_has_come() -> None:
    times, sent_ns = LineTimes("busy", 1), np.arange(0, 60_000_000_000, 1_000_000)
    passed_ns = np.array([times.from_robot(time_ns) for time_ns in sent_ns.tolist()])
    late_ns = passed_ns - sent_ns
    assert np.all(np.diff(passed_ns) >= 0)
    assert 0.5e6 < np.median(late_ns) < 5e6  # Most of those behind a long delay share it.
    assert 12e6 < late_ns.max() < 26e6


def test_an_adapter_delivers_at_the_ends_of_its_intervals() -> None:
    times = LineTimes("packets", 1)
    passed_ns = [times.from_robot(time_ns) for time_ns in range(0, 100_000_000, 1_000_000)]
    assert len({time_ns % PACKET_NS for time_ns in passed_ns}) == 1
    assert len(set(passed_ns)) == 7


def test_a_line_stalls_once_in_each_ten_seconds() -> None:
    times = LineTimes("stalls", 1)
    late: dict[str, set[int]] = {"host": set(), "to": set(), "from": set()}
    for time_ns in range(0, 10 * STALL_EVERY_NS, 10_000_000):
        ways = {
            "host": times.host(time_ns),
            "to": times.to_robot(time_ns)[1],
            "from": times.from_robot(time_ns),
        }
        for way, passed_ns in ways.items():
            if passed_ns > time_ns:
                late[way].add(passed_ns)
                assert passed_ns <= time_ns + STALL_NS
    assert late["host"] < late["from"]  # A relay that stands still delivers nothing either.
    assert sorted(time_ns // STALL_EVERY_NS for time_ns in late["to"] | late["from"]) == list(range(10))


def test_a_recording_is_the_same_each_time(tmp_path: Path) -> None:
    changes, faults = [Added(0.0, CAN), Lifted(2.0)], ["drop:0.02@1"]
    for name in ("one", "two"):
        record(
            tmp_path / f"{name}.mcap",
            PLAYPEN,
            seed=1,
            seconds=3,
            host="wanderer",
            faults=faults,
            changes=changes,
        )
    assert (tmp_path / "one.mcap").read_bytes() == (tmp_path / "two.mcap").read_bytes()
    one, two = (Truth.load(tmp_path / f"{name}.npz") for name in ("one", "two"))
    assert np.array_equal(one.poses, two.poses)
    assert one.hidden.tolist() == two.hidden.tolist()


def test_a_recording_has_what_a_relay_of_a_robot_has(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    truth = record(path, PLAYPEN, seed=2, seconds=2, host="avoider", asks_counters=True)
    series = read_series(path)
    assert json.loads(series.label.attachments["configuration.json"]) == {"relay": "stand-in", "baud": 9600}
    assert "playpen.toml" not in series.label.attachments
    assert set(series.series) == {"/khepera0/proximity"}
    lines = series.lines["/khepera0/serial"]
    commands, replies = lines[::2], lines[1::2]
    assert [line.text[0] for line in commands[:6]] == ["N", "H", "D", "N", "H", "D"]
    for command, reply in zip(commands, replies, strict=False):
        assert reply.text[0] == command.text[0].lower()
        # A line has the time of the first byte of its end.
        n_bytes = len(command.text) + 1 + len(reply.text) + 1
        assert reply.time_ns - command.time_ns == pytest.approx(n_bytes * BITS_PER_BYTE / 9600 * 1e9, abs=10)
    assert truth.times_ns[:3].tolist() == [0, 20_000_000, 40_000_000]
    assert np.hypot(*(truth.start - truth.twin_start)[:2]) <= 0.010
    assert abs(truth.start - truth.twin_start)[2] <= np.radians(5)


def test_a_log_by_pyserial_alone_has_replies_when_they_are_read(tmp_path: Path) -> None:
    ends_ns: list[list[int]] = []
    for times in ("exact", "pyserial"):
        record(tmp_path / f"{times}.mcap", PLAYPEN, seed=2, seconds=1, host="avoider", times=times)
        lines = read_series(tmp_path / f"{times}.mcap").lines["/khepera0/serial"]
        ends_ns.append([lines[i + 1].time_ns - lines[i].time_ns for i in range(0, len(lines) - 1, 2)])
    exact, pyserial = map(np.array, ends_ns)
    # Later by the last byte, and by what the host is late.
    assert np.all(pyserial[:10] - exact[:10] > BITS_PER_BYTE / 9600 * 1e9)


def test_a_slow_host_asks_two_and_a_half_times_a_second(tmp_path: Path) -> None:
    record(tmp_path / "run.mcap", PLAYPEN, seed=2, seconds=2, host="slow")
    lines = read_series(tmp_path / "run.mcap").lines["/khepera0/serial"]
    asked_ns = [line.time_ns for line in lines if line.text == "N"]
    assert np.diff(asked_ns) == pytest.approx(400_000_000, abs=3_000_000)


def test_a_change_is_noticeable_from_the_first_reply_on_that_it_changes(tmp_path: Path) -> None:
    def noticed(faults: list[str], *changes: Lifted | Removed | Added) -> tuple[int, int]:
        truth = record(
            tmp_path / "run.mcap",
            PLAYPEN,
            seed=3,
            seconds=2,
            host="wanderer",
            faults=faults,
            changes=changes,
            start=(345.0, 240.0, 0.0),
            start_error=(0.0, 0.0, 0.0),
        )
        return int(truth.changed_ns[0]), int(truth.noticeable_ns[0])

    lifted_ns, seen_ns = noticed([], Lifted(1.0, (40.0, 200.0, 90.0)))
    assert lifted_ns == 1_000_000_000
    assert 0 < seen_ns - lifted_ns < 200_000_000
    reset_ns, heard_ns = noticed(["brown-out@1"])
    assert 0 < heard_ns - reset_ns < 400_000_000
    # It never comes near this one.
    assert noticed([], Removed(1.0, "cylinder2"))[1] == -1


def test_the_end_of_a_fault_is_noticeable_where_a_robot_that_keeps_it_replies_otherwise(
    tmp_path: Path,
) -> None:
    path, faults = tmp_path / "run.mcap", ["dead:left@0.2-1", "drop:0.1@1.2-1.4", "brown-out@1.5"]
    truth = record(path, PLAYPEN, seed=3, seconds=2, host="wanderer", asks_counters=True, faults=faults)
    motor_ns, line_ns, reset_ns = truth.over_ns.tolist()
    assert 1_000_000_000 < motor_ns < 1_500_000_000
    assert (line_ns, reset_ns) == (1_400_000_000, -1)


@pytest.mark.parametrize(
    "change",
    [
        Moved(0.0, "block0", (-120.0, 0.0), 30.0),
        Removed(0.0, "cylinder0"),
        Added(0.0, CAN.model_copy(update={"x_mm": 410.0, "y_mm": 150.0})),
    ],
    ids=lambda change: type(change).__name__,
)
def test_a_changed_world_is_that_of_the_changed_playpen(change: Moved | Removed | Added) -> None:
    """The robot drives for two seconds, and all its counts are those of a scene compiled like that."""
    dark_playpen = PLAYPEN.model_copy(update={"lamps": ()})
    world = looking(with_added(dark_playpen, [change]))
    hide_added(world, dark_playpen)
    assert apply(world, change, 3, stream(0, "changes")) == change
    compiled = looking(world.playpen.model_copy(update={"cylinders": world.playpen.cylinders}))
    for simulated in (world, compiled):
        simulated.scan()
        simulated.robots[0].send(b"D,8,7\n")
        simulated.advance_to(2_000_000_000)
    assert world.robots[0].registers.tolist() == compiled.robots[0].registers.tolist()
    assert world.poses == compiled.poses
