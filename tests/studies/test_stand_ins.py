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
from stand_ins.hidden_changes import Added, Gone, Lifted, Moved, apply, hide_added, with_added
from stand_ins.recordings import Truth, record

PLAYPEN = Playpen.load("workshop")
CAN = Cylinder(x_mm=345, y_mm=190, radius_mm=15, height_mm=50)


def looking(playpen: Playpen) -> World:
    return World(playpen, noise=False, compiled=True)


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
    found = read_series(path)
    assert json.loads(found.label.attachments["configuration.json"]) == {"relay": "stand-in", "baud": 9600}
    assert "playpen.toml" not in found.label.attachments
    assert set(found.series) == {"/khepera0/proximity"}
    lines = found.lines["/khepera0/serial"]
    commands, replies = lines[::2], lines[1::2]
    assert [line.text[0] for line in commands[:6]] == ["N", "H", "D", "N", "H", "D"]
    for command, reply in zip(commands, replies, strict=False):
        assert reply.text[0] == command.text[0].lower()
        # A line has the time of the first byte of its end.
        n_bytes = len(command.text) + 1 + len(reply.text) + 1
        assert reply.time_ns - command.time_ns == pytest.approx(n_bytes * BITS_PER_BYTE / 9600 * 1e9, abs=10)
    assert truth.times_ns[:3].tolist() == [0, 20_000_000, 40_000_000]
    assert np.hypot(*(truth.start - truth.told)[:2]) <= 0.010
    assert abs(truth.start - truth.told)[2] <= np.radians(5)


def test_a_change_is_noticeable_from_the_first_reply_on_that_it_changes(tmp_path: Path) -> None:
    def noticed(faults: list[str], *changes: Lifted | Gone | Added) -> tuple[int, int]:
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
    assert noticed([], Gone(1.0, "cylinder2"))[1] == -1


@pytest.mark.parametrize(
    "change",
    [
        Moved(0.0, "block0", (-120.0, 0.0), 30.0),
        Gone(0.0, "cylinder0"),
        Added(0.0, CAN.model_copy(update={"x_mm": 410.0, "y_mm": 150.0})),
    ],
    ids=lambda change: type(change).__name__,
)
def test_a_changed_world_is_that_of_the_changed_playpen(change: Moved | Gone | Added) -> None:
    """The robot drives for two seconds, and all its counts are those of a scene compiled like that."""
    told = PLAYPEN.model_copy(update={"lamps": ()})
    world = looking(with_added(told, [change]))
    hide_added(world, told)
    assert apply(world, change, 3, stream(0, "changes")) == change
    compiled = looking(world.playpen.model_copy(update={"cylinders": world.playpen.cylinders}))
    for each in (world, compiled):
        each.scan()
        each.robots[0].send(b"D,8,7\n")
        each.advance_to(2_000_000_000)
    assert world.robots[0].registers.tolist() == compiled.robots[0].registers.tolist()
    assert world.poses == compiled.poses
