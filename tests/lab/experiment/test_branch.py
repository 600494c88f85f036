"""Branches: a logged run is resumed at a branch point and equals its parent up to there."""

from dataclasses import replace
from pathlib import Path

import pytest
from command_line import khep_twin
from log_rewriting import rewritten
from served_twin import served

from checks.branches import check, content_before, messages
from khep_twin.errors import KhepTwinError, LogError, PlaypenError
from khep_twin.host import Khepera
from khep_twin.interventions.switching import switch
from khep_twin.lab.experiment.branch import BranchPlan, branch, calibration_texts
from khep_twin.lab.experiment.controllers import braitenberg
from khep_twin.lab.experiment.repeat import repeat
from khep_twin.log.reader import read_label, read_log
from khep_twin.log.recorded import BranchPoint, read_recorded_run
from khep_twin.log.snapshots import read_snapshot
from khep_twin.ports.protocol_khep import Serial
from khep_twin.ports.resume import resume_run, run_end_ns
from khep_twin.ports.twin import TwinOptions, open_twin

SECOND = 1_000_000_000
AT_NS = 11_234_567_890
SHARE = (12, 18, 74)
"""Numbers of short logs with faults of all devices, a gripper, and lamps that shine in sequence at random.

The first one is resumed from a snapshot, and has late replies."""

ARENA = Path("khep_twin/assets/playpens/obstacles.toml")


@pytest.fixture(scope="module")
def parent(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A log of 13 seconds of a Braitenberg vehicle among movable blocks."""
    folder = tmp_path_factory.mktemp("logs")
    arena = folder / "arena.toml"
    loose = "x_mm = 400\ny_mm = 510\nlength_mm = 30\nwidth_mm = 30\nheight_mm = 30\nmovable = true\n"
    arena.write_text(f"{ARENA.read_text()}\n[[block]]\n{loose}")
    log = folder / "run.mcap"
    with open_twin(arena, TwinOptions(seed=5, log=str(log))) as twin:
        robot = Khepera(Serial.of(twin, timeout=1.0))
        while robot.time < 13:
            braitenberg(robot)
    return log


def branch_at(parent: Path, tmp_path: Path, **changes: object) -> Path:
    path = tmp_path / "new.mcap"
    branch(BranchPlan(parent, BranchPoint(AT_NS, **changes)), path)  # type: ignore[arg-type]
    return path


@pytest.mark.share(3)
@pytest.mark.parametrize("number", SHARE)
def test_a_share_of_the_search_finds_nothing(number: int, tmp_path: Path) -> None:
    assert check(number, tmp_path) == []


def test_a_log_has_a_snapshot_every_ten_seconds_and_at_the_end(parent: Path) -> None:
    snapshots = [(time_ns, data) for topic, time_ns, data in messages(parent) if topic == "/snapshot"]
    assert [time_ns for time_ns, _ in snapshots] == [10 * SECOND, run_end_ns(parent)]
    assert [read_snapshot(data, None).world.time_ns for _, data in snapshots] == [
        time for time, _ in snapshots
    ]
    assert all(len(data) < 4000 for _, data in snapshots)


def test_without_a_change_the_parents_run_goes_on(parent: Path, tmp_path: Path) -> None:
    path = branch_at(parent, tmp_path)
    assert messages(path) == messages(parent)
    label = read_label(path)
    assert label.metadata["parent"] == "run.mcap"
    assert len(label.metadata["parent_sha256"]) == 64
    assert label.metadata["branched_at_s"] == "11.2345679"
    assert '"at_ns": 11234567890' in label.attachments["branch.json"]


@pytest.mark.share(6)
@pytest.mark.parametrize(
    "changes",
    [
        {"seed": 9},
        {"faults": ("stuck:2", "dead:left@12")},
        {"edits": ("block.1.height_mm=5", "lamp.1.power_w=2")},
        {"edits": ("block.9.x_mm=500", "robot.1.heading_deg=0")},
        {"edits": ("lamp.1.dim=0.1",)},
        {"calibrations": {"khepera0": Path("khep_twin/assets/calibration/khepera1-manual.toml").read_text()}},
    ],
    ids=["seed", "faults", "playpen", "things put elsewhere", "what no scene holds", "calibration"],
)
def test_a_change_changes_what_follows_and_the_new_log_can_be_repeated(
    parent: Path, tmp_path: Path, changes: dict[str, object]
) -> None:
    path = branch_at(parent, tmp_path, **changes)
    assert content_before(path, AT_NS) == content_before(parent, AT_NS)
    assert messages(path) != messages(parent)
    assert run_end_ns(path) == run_end_ns(parent)
    assert repeat(read_recorded_run(path)) is None
    assert any(line.text.startswith("branched off, with ") for line in read_log(path).events)


def test_what_is_put_elsewhere_is_there_and_all_else_goes_on(parent: Path) -> None:
    resumed = resume_run(parent, AT_NS)
    world = resumed.twin.world
    x, y, heading = world.robots[0].pose
    speed = world.data.qvel[world.robots[0].indices.wheel_dofs[0]]
    resumed.change(BranchPoint(AT_NS, edits=("block.9.x_mm=500", "block.9.y_mm=350")))
    moved = resumed.twin.world
    moved.advance_to(AT_NS + 5_000_000)
    assert moved.data.body("block8").xpos[:2] == pytest.approx([0.5, 0.35], abs=1e-4)
    assert moved.robots[0].pose == pytest.approx((x, y, heading), abs=2e-3)
    assert moved.data.qvel[moved.robots[0].indices.wheel_dofs[0]] == pytest.approx(speed, rel=0.2)


def test_a_lamp_that_is_edited_stays_switched_off_and_things_outside_stay_there(parent: Path) -> None:
    resumed = resume_run(parent, AT_NS)
    world = resumed.twin.world
    switch(world, 0, False)
    block = world.model.body(f"block{len(world.playpen.blocks) - 1}")
    world.data.qpos[world.model.jnt_qposadr[block.jntadr[0]]] = -0.1
    resumed.change(BranchPoint(AT_NS, edits=("lamp.1.power_w=2",)))
    changed = resumed.twin.world
    changed.advance_to(AT_NS + 5_000_000)
    assert changed.lamps.powers[0] == 0.0
    assert changed.data.body(block.name).xpos[0] == pytest.approx(-0.1, abs=1e-3)


def test_a_controller_takes_over_and_a_branch_has_branches(parent: Path, tmp_path: Path) -> None:
    first, second, same = (tmp_path / f"{name}.mcap" for name in ("first", "second", "same"))
    branch(BranchPlan(parent, BranchPoint(AT_NS, seed=3), braitenberg, seconds=10.0), first)
    assert read_label(first).metadata["controller"] == "braitenberg"
    assert run_end_ns(first) > 21 * SECOND
    later_ns = round(20.5 * SECOND)
    branch(BranchPlan(first, BranchPoint(later_ns, faults=("stuck:1",))), second)
    assert content_before(second, later_ns) == content_before(first, later_ns)
    assert repeat(read_recorded_run(second)) is None
    branch(BranchPlan(second, BranchPoint(21 * SECOND)), same)
    assert messages(same) == messages(second)


def test_a_log_without_snapshots_is_run_again_from_its_start(parent: Path, tmp_path: Path) -> None:
    old = rewritten(parent, tmp_path / "old.mcap", rename=lambda topic: topic.replace("/snapshot", "/other"))
    resumed, restored = resume_run(old, AT_NS), resume_run(parent, AT_NS)
    assert resumed.twin.world.snapshot() == restored.twin.world.snapshot()


@pytest.mark.parametrize(
    ("changes", "line"),
    [
        ({"edits": ("block.19.x_mm=5",)}, r"'block.19.x_mm=5'; did you mean '9'\? \(choices: 1, 2, 3"),
        ({"edits": ("blok.1.x_mm=5",)}, "did you mean 'block'"),
        ({"edits": ("block.1.heigth_mm=5",)}, "unknown key; did you mean 'height_mm'"),
        ({"edits": ("block.1",)}, "expected TABLE.NUMBER.KEY=VALUE"),
        ({"edits": ("block.1.x_mm=far",)}, "expected a number"),
        ({"edits": ("robot.1.x_mm=0",)}, "robot 1 at .* overlaps the left wall"),
        ({"edits": ("block.1.surface=velvet",)}, "surface"),
        ({"faults": ("stuck:9",)}, "fault 'stuck:9': robot 0 is a Khepera; expected a number below 8"),
    ],
)
def test_a_change_that_cannot_be_made_is_one_line_and_leaves_no_log(
    parent: Path, tmp_path: Path, changes: dict[str, object], line: str
) -> None:
    with pytest.raises(PlaypenError if "surface" in line else KhepTwinError, match=line) as error:
        branch_at(parent, tmp_path, **changes)
    assert len(str(error.value).splitlines()) == 1
    assert not list(tmp_path.iterdir())


def test_a_controller_that_is_refused_before_its_first_step_leaves_no_log(
    parent: Path, tmp_path: Path
) -> None:
    path = tmp_path / "new.mcap"
    plan = BranchPlan(parent, BranchPoint(AT_NS), braitenberg, cycles=2)
    with pytest.raises(LogError, match="robot = 7; expected 0 to 0"):
        branch(replace(plan, robot=7), path)
    assert not list(tmp_path.iterdir())
    branch(plan, path)
    assert list(tmp_path.iterdir()) == [path]


def test_a_moment_outside_the_run_and_a_damaged_snapshot_are_one_line(parent: Path, tmp_path: Path) -> None:
    for at_ns in (0, 60 * SECOND):
        with pytest.raises(LogError, match=r"cannot be resumed at .* expected above 0 and up to its end"):
            branch(BranchPlan(parent, BranchPoint(at_ns)), tmp_path / "new.mcap")
    with open_twin("default", TwinOptions()) as twin:
        twin.record(tmp_path / "begun.mcap")
    with pytest.raises(LogError, match="the run ends at 0 s; expected a longer run"):
        branch(BranchPlan(tmp_path / "begun.mcap", BranchPoint(AT_NS)), tmp_path / "new.mcap")
    with pytest.raises(LogError, match="this is the log that is resumed"):
        branch(BranchPlan(parent, BranchPoint(AT_NS)), parent)

    def spoilt(topic: str, time_ns: int, data: bytes) -> bytes:
        return data[:-9] if topic == "/snapshot" else data

    torn = rewritten(parent, tmp_path / "torn.mcap", spoilt)
    with pytest.raises(LogError, match=r"torn.mcap: /snapshot at 10.0000 s: .*expected at most") as error:
        resume_run(torn, AT_NS)
    assert len(str(error.value).splitlines()) == 1


def test_a_calibration_is_for_the_robots_on_the_line(parent: Path) -> None:
    assert list(calibration_texts(parent, "khepera1-manual", None)) == ["khepera0"]
    assert calibration_texts(parent, "khepera1-manual", 3) == {}


def test_a_host_goes_on_from_a_log_and_its_log_is_a_branch(parent: Path, tmp_path: Path) -> None:
    path = tmp_path / "new.mcap"
    with Khepera(f"khep://{parent}?at=11.5&seed=4&fault=late:0.5:20&log={path}") as robot:
        assert robot.time == 11.5
        robot.set_speed(5, 5)
        robot.sleep(1)
    at_ns = 11_500_000_000
    assert content_before(path, at_ns) == content_before(parent, at_ns)
    assert repeat(read_recorded_run(path)) is None
    with Khepera(f"khep://{parent}") as robot:
        assert robot.time == run_end_ns(parent) / SECOND
    with Serial(f"khep://{parent}?at=11.5&fault=brown-out@3", timeout=1) as port:
        assert port.read_until(b"ROM") == b"ROM"  # it is due at once
        assert port.time_ns < 11_560_000_000
    for url, line in (
        (f"khep://{parent}?at=11&noise=off", "noise is set by the log"),
        (f"khep://{parent}?at=11&robot=2", "robot = 2: not in"),
        (f"khep://{parent}?at=soon", "expected a moment of the log's run in seconds"),
        ("khep://default?at=3", "at = 3 is for a log"),
    ):
        with pytest.raises(KhepTwinError, match=line):
            Khepera(url)


def test_what_was_sent_last_is_not_part_of_a_run_that_is_taken_up_at_its_end(tmp_path: Path) -> None:
    first, second = tmp_path / "first.mcap", tmp_path / "second.mcap"
    with Serial() as port:
        port.port = f"khep://default?log={first}"
        port.open()
        port.sleep(0.5)
        port.write(b"D,5,5\n")
    with Serial() as port:
        port.port = f"khep://{first}?seed=2&fault=drop:0.5&log={second}"
        port.open()
        for _ in range(20):
            port.write(b"N\n")
            port.sleep(0.1)
        assert port.twin.world.time_ns == run_end_ns(first) + 2 * SECOND
    assert b"D,5,5" not in b"".join(data for _, _, data in messages(second))
    assert repeat(read_recorded_run(second)) is None


def test_a_served_log_goes_on(parent: Path, tmp_path: Path) -> None:
    path = tmp_path / "new.mcap"
    with served("--from", f"{parent}@12.5", "--log", str(path), "--clock", "wire") as (process, port):
        with Khepera(port) as robot:
            assert robot.speed() is not None
        process.terminate()
        assert process.wait(60) == 0
    assert content_before(path, 12_500_000_000) == content_before(parent, 12_500_000_000)
    assert repeat(read_recorded_run(path)) is None


def test_the_command_writes_a_log_each_and_draws_their_fan(parent: Path, tmp_path: Path) -> None:
    words = ("branch", parent, "--at", 12.9, "-o", tmp_path / "fan.mcap", "--runs", 3, "--seconds", 1)
    completed = khep_twin(*words, "--controller", "braitenberg")
    assert completed.returncode == 0, completed.stderr
    assert "fan-001.mcap to fan-003.mcap" in completed.stdout
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"fan-001.mcap", "fan-002.mcap", "fan-003.mcap", "fan.png"}
    seeds = [read_recorded_run(tmp_path / f"fan-00{number}.mcap").changes[0].seed for number in (1, 2, 3)]
    assert seeds == [1, 2, 3]
    assert "is there already" in khep_twin(*words).stderr
    assert "expected --controller" in khep_twin(*words, "--force", "--cycles", 3).stderr


def test_each_branch_has_a_controller_of_its_own_that_is_stopped(parent: Path, tmp_path: Path) -> None:
    (tmp_path / "counts.py").write_text(
        "import os\n"
        "from khep_twin.lab.experiment.controllers import Controller\n"
        "class Counts(Controller):\n"
        "    n = 0\n"
        "    def start(self, robot):\n"
        "        self.n += 1\n"
        "    def cycle(self, robot):\n"
        "        robot.set_speed(2, 2)\n"
        "    def stop(self, robot):\n"
        "        print('stopped', self.n)\n"
        "        os.chdir('/')\n"
    )
    words = ("branch", parent, "--at", 12.9, "-o", tmp_path / "fan.mcap", "--runs", 2, "--cycles", 3)
    completed = khep_twin(*words, "--controller", "counts.py", folder=tmp_path)
    assert completed.stdout.count("stopped 1") == 2, completed.stderr
