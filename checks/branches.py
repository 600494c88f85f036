"""Random logs resumed at random moments: equal to their parent if unchanged, else equal before the change.

    python -m checks branches 200

Each log depends on its number alone, so that findings are reproducible: `--first NUMBER` starts there.
Playpens, robots, faults and hosts are random. Hosts send any command at any time, and users move robots and
change lamps. A finding is a branch without a change whose messages or their order differ from its parent's; a
branch with a change that differs before the change; or a difference that `repeat` finds in that branch.
"""

import tempfile
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
from mcap.reader import make_reader

from khep_twin import playpen
from khep_twin.board.uart import LineSettings
from khep_twin.clock import NS_PER_S
from khep_twin.errors import ControllerError, KhepTwinError, PlaypenError, PortError, ProtocolError
from khep_twin.interventions.move_robot import place_robot, scan
from khep_twin.interventions.switching import set_lamps, switch
from khep_twin.lab.experiment.branch import BranchPlan, branch
from khep_twin.lab.experiment.controllers import BUILT_IN
from khep_twin.lab.experiment.repeat import repeat
from khep_twin.log.host_events import read_events
from khep_twin.log.recorded import BranchPoint, read_recorded_run
from khep_twin.log.snapshots import read_states
from khep_twin.observers import SAMPLE_NS
from khep_twin.playpen import Lamp, Lighting, Playpen
from khep_twin.ports.twin import TwinOptions, open_twin
from khep_twin.robots.model import Feature
from khep_twin.units import STEP_NS
from khep_twin.world import World
from tools.command_table import command_line

WORDS4 = "D,90,40 N O D,-30,80 K,9,0,0,0,9,0,0,0,9 R F,9000,5000 B G E L,600,-400 U,5 S T V,0 Z A,0".split()
"""Commands of a Khepera IV."""

WORDS = "D,9,4 N O D,-3,8 L,0,2 H D,10,10 K C,900,500 B D,20,19 E P,60,-40 J,20,64,20,64 G,0,0".split()
ARM = "T,1,E,255 T,1,D,1 T,1,E,152 T,1,D,0 T,1,G T,1,H,1 T,1,F".split()

FAULTS = (
    "drop:0.02 drop:0.05@4-9 garble:0.02 garble:0.1@3-3.7 late:0.2:60 late:0.5:20@6-11.003 stuck:2@5 stuck:6 "
    "stuck:4@2-8.0013 dead:left@7 dead:right@12.5 dead:right@3-6 dead:3 dead:5@4.2-13 weak:left:0.4 "
    "weak:right:0.2@2.5-10.2 slip:left:0.1@3 slip:right:0.3@1-7.7 slip:left:0.05@6-12 blocked:left@2.2-5.1 "
    "blocked:right@9-9.9 brown-out@9 brown-out@2.003"
).split()

LINE_FAULTS = "drop", "garble", "late", "brown-out"

LAMPS = """
[[lamp]]
x_mm = 620
y_mm = 80
power_w = 9
blink_period_s = 0.7
fade_s = 0.2
flicker = 0.4
"""

ROBOTS = """
[[robot]]
x_mm = 330
y_mm = 300
heading_deg = 90
[[robot]]
x_mm = 250
y_mm = 320
heading_deg = -20
model = "khepera2"
"""

PUSHED = "".join(
    f"\n[[block]]\nx_mm = {x_mm}\ny_mm = 500\nlength_mm = 30\nwidth_mm = 30\nheight_mm = 30\nmovable = true\n"
    for x_mm in (100, 200, 300, 400, 500, 600)
)


def arena(extra: str = "", **changes: object) -> Playpen:
    """Return the shipped obstacles with additional TOML text, and with changes of the first robot."""
    base = playpen.parse(playpen.dump(Playpen.load("obstacles")) + extra, "arena")
    robots = (base.robots[0].model_copy(update=changes), *base.robots[1:])
    return base.model_copy(update={"robots": robots})


def drive(world: World, seed: int, end_ns: int) -> None:
    """Let hosts and users act at random up to a time, reproducibly for the same state and seed."""
    while world.time_ns < end_ns:
        rng = np.random.default_rng([seed, world.time_ns])
        for robot in world.robots:
            is_khepera = Feature.LINE in world.playpen.robots[robot.index].robot_model.features
            words = (WORDS if is_khepera else WORDS4) + ARM * bool(robot.firmware.turrets)
            robot.uart.tx.read(world.time_ns)
            robot.send(f"{rng.choice(words)}\n".encode() * int(rng.integers(1, 3)))
            match int(rng.integers(30)):
                case 0:
                    robot.send(b"N\nD,5", world.time_ns + 3_000_000)
                case 1:
                    robot.disconnect()
                case 2:
                    if notice := robot.set_host_line(LineSettings(int(rng.choice([9600, 19200])), 2)):
                        world.log_event(robot.index, notice)
                case 3:
                    robot.flush()
                case 4:
                    robot.send(b"restart\n")
                case _:
                    pass
        match int(rng.integers(60)):
            case 0 if world.lamps.names:
                switch(world, 0, on=bool(rng.integers(2)))
            case 1 if world.lamps.names:
                with suppress(PlaypenError):  # no place for a lamp
                    set_lamps(world, [Lamp(x_mm=200, y_mm=100, power_w=3, flicker=0.2)], Lighting())
            case 2:
                scan(world)
            case 3:
                x, y, heading = world.robots[0].pose
                with suppress(PlaypenError):  # no room
                    place_robot(world, 0, x * 1e3, y * 1e3, np.degrees(heading) + 10, reset=True)
            case _:
                pass
        # Also between steps.
        world.advance_to(min(world.time_ns + int(rng.integers(1, 300_000_000)), end_ns))


def faults_of(playpen_of: Playpen) -> Sequence[str]:
    """Return the faults that all robots of a playpen may have; a Khepera IV has those of its line."""
    if all(Feature.LINE in robot.robot_model.features for robot in playpen_of.robots):
        return FAULTS
    return [fault for fault in FAULTS if fault.partition(":")[0].partition("@")[0] in LINE_FAULTS]


def make(number: int, path: Path) -> float:
    """Write the log of a number; return when its run ends [s]."""
    rng = np.random.default_rng([number, 1])
    scenes = [
        *(lambda name=name: Playpen.load(name) for name in playpen.names()),
        *(lambda extra=extra: arena(extra) for extra in ("", LAMPS, ROBOTS, PUSHED, LAMPS + PUSHED + ROBOTS)),
        lambda: arena(battery_used_min=41.0),
        lambda: arena(PUSHED, turrets=("gripper",)),
        lambda: Playpen.load("two-lamps").model_copy(update={"lighting": Lighting(mode="random")}),
    ]
    scene = scenes[number % len(scenes)]()
    options = TwinOptions(
        seed=int(rng.integers(1000)),
        robot=None,
        noise=rng.random() < 0.9,
        vary=rng.random() < 0.3,
        unpaced=rng.random() < 0.1,
        strict_line=rng.random() < 0.2,
        faults=tuple(rng.choice(faults_of(scene), int(rng.integers(0, 5)), replace=False).tolist()),
    )
    end_s = float(rng.uniform(2, 23))
    with open_twin(scene, options) as twin:
        # Some worlds change over to compiled code amid the run.
        twin.world.code.switch_step = int(rng.integers(0, 8000))
        twin.record(path)
        with suppress(KhepTwinError):  # a run that has diverged is also a log
            drive(twin.world, number, round(end_s * NS_PER_S))
        return twin.world.time_ns / NS_PER_S


def change_of(number: int, at_ns: int, playpen_of: Playpen) -> tuple[BranchPoint, bool]:
    """Return a change, and whether a controller takes over."""
    rng = np.random.default_rng([number, 2])
    edits = ["arena.wall_height_mm=60"]
    edits += [f"block.{place + 1}.height_mm=45" for place in range(len(playpen_of.blocks))]
    edits += [f"lamp.{place + 1}.power_w=2" for place in range(len(playpen_of.lamps))]
    change = BranchPoint(
        at_ns,
        seed=int(rng.integers(1000)) if rng.random() < 0.5 else None,
        faults=tuple(rng.choice(faults_of(playpen_of), int(rng.integers(0, 3)), replace=False).tolist()),
        edits=(str(rng.choice(edits)),) if rng.random() < 0.4 else (),
    )
    # The controller is a Khepera's.
    return change, bool(rng.random() < 0.5) and Feature.LINE in playpen_of.robots[0].robot_model.features


def messages(path: Path) -> list[tuple[str, int, bytes]]:
    """Return topic, time and bytes of a log's messages in the order of the file."""
    with path.open("rb") as file:
        entries = make_reader(file).iter_messages(log_time_order=False)
        return [(channel.topic, message.log_time, message.data) for _, channel, message in entries]


def content_before(path: Path, at_ns: int) -> Counter[tuple[str, int, object]]:
    """Return the messages of a log before a moment, with events of hosts and states one by one.

    The time of an event is the start of its step; its cause may come after the moment within that step.
    """
    contents: Counter[tuple[str, int, object]] = Counter()
    for topic, time_ns, data in messages(path):
        if topic == "/events" and time_ns >= at_ns - at_ns % STEP_NS:
            continue
        entries: list[tuple[int, object]] = [(time_ns, data)]
        if topic == "/state":
            entries = [(time_ns + SAMPLE_NS * place, state) for place, state in enumerate(read_states(data))]
        elif topic.endswith("/host_events"):
            entries = list(read_events(data))
        contents.update((topic, at, content) for at, content in entries if at < at_ns)
    return contents


def check(number: int, folder: Path) -> list[str]:
    """Return the findings of a number."""
    parent, same, other = (folder / f"{name}.mcap" for name in ("parent", "same", "other"))
    end_s = make(number, parent)
    rng = np.random.default_rng([number, 3])
    at_ns = max(round(float(rng.uniform(0, end_s)) * NS_PER_S), 1)
    if rng.random() < 0.3:  # at a sample, or at a snapshot
        at_ns = max(at_ns // SAMPLE_NS, 1) * SAMPLE_NS if end_s < 10 or rng.random() < 0.5 else 10 * NS_PER_S
    findings: list[str] = []
    try:
        branch(BranchPlan(parent, BranchPoint(at_ns)), same)
        if messages(same) != messages(parent):
            findings.append("without a change it is not the parent's run")
    except KhepTwinError as error:
        findings.append(f"without a change: {error}")
    change, takes_over = change_of(number, at_ns, open_playpen(parent))
    controller = BUILT_IN["braitenberg"] if takes_over else None
    try:
        branch(BranchPlan(parent, change, controller, 0 if takes_over else None, seconds=4.0), other)
    except (ProtocolError, ControllerError, PortError):
        pass  # a controller gives up on a bad line, on one without time, or on a board with another program
    except PlaypenError:
        return findings  # no room, or a lamp that is no longer there
    except KhepTwinError as error:
        return [*findings, f"with {change.text or 'a controller'}: {error}"]
    if content_before(other, at_ns) != content_before(parent, at_ns):
        findings.append(f"with {change.text or 'a controller'} it differs before {at_ns / NS_PER_S} s")
    if number % 4 == 0 and (difference := repeat(read_recorded_run(other))) is not None:
        findings.append(f"with {change.text or 'a controller'} it is not repeated: {difference}")
    return findings


def open_playpen(path: Path) -> Playpen:
    """Return the playpen of a log."""
    return playpen.parse(read_recorded_run(path).label.attachments["playpen.toml"], str(path), recorded=True)


def main() -> int:
    """Check as many logs as were asked for; return the number of findings, at most 1."""
    parser = command_line(__doc__)
    parser.add_argument("count", type=int, nargs="?", default=200, help="number of logs")
    parser.add_argument("--first", type=int, default=0, help="number of the first one")
    typed = parser.parse_args()
    n_findings = 0
    for number in range(typed.first, typed.first + typed.count):
        with tempfile.TemporaryDirectory() as folder:
            for finding in check(number, Path(folder)):
                n_findings += 1
                print(f"log {number}: {finding}", flush=True)
    print(f"{typed.count} logs from {typed.first} on, {n_findings} findings")
    return min(n_findings, 1)
