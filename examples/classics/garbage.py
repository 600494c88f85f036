"""Garbage collecting with the gripper, after Nolfi (1997): a robot puts five cylinders out of the arena.

    .venv/bin/python examples/classics/garbage.py --picture garbage.png

His networks evolved; this controller is written by hand, as a host on khep:// in lock-step. It uses the
robot's commands at 9600 baud, so it also drives a real robot. It has the built-in procedures of his work:
lower, close and lift when an object is between the fingers; reach over the wall, which is lower than the arm,
and open. It distinguishes cylinders from walls by motion. It turns on the spot until the front sensors lose
the object, to either side; a wall stays in sight longer. Each trial has five cylinders and another seed.
"""

import argparse
import contextlib
from pathlib import Path

import numpy as np

from khep_twin import Gripper, Khepera, MoveError, Playpen
from khep_twin.drawing import DrawnPath, draw, save
from khep_twin.files import unusable
from khep_twin.host import turn_pulses
from khep_twin.randomness import stream

parser = argparse.ArgumentParser(description="Clear an arena of cylinders.")
parser.add_argument("--trials", type=int, default=10)
parser.add_argument("--seconds", type=float, default=500.0, help="longest duration of a trial")
parser.add_argument("--seed", type=int, default=0, help="seed of the first trial")
parser.add_argument("--picture", type=Path, help="draw the first trial's path to this PNG, SVG or PDF file")
options = parser.parse_args()
if options.picture is not None and (reason := unusable(options.picture)):
    parser.error(f"{options.picture}: cannot be written: {reason}")

ARENA = Playpen.load("garbage")
SIDES_MM = ARENA.arena.width_mm, ARENA.arena.height_mm
DETECTION, LOST = 200, 60
"""Counts from which an object is examined, and below which it is out of sight."""
WALL_DEG = 92
"""Angle over which most walls are in sight and cylinders are not (72 to 87 degrees in a trial)."""
OVER_WALL = 225
"""Position of the arm that holds an object over the wall, 30 mm high."""
DARK, THICK = 200, 120
"""Light barrier from which an object is between the fingers, and their position around one of 33 mm."""


class Collector:
    """Controller of a robot with a gripper.

    Args:
        robot: Robot.
        rng: Generator of its random turns.
    """

    def __init__(self, robot: Khepera, rng: np.random.Generator) -> None:
        self.robot, self.gripper, self.rng = robot, Gripper(robot), rng
        self.carrying, self.picked_up = False, 0
        self.gripper.lift()
        self.gripper.open()
        self.gripper.wait()

    def cycle(self) -> None:
        """Drive ahead, or handle an object in sight."""
        counts = self.robot.proximity()[:6]
        if max(counts) < DETECTION:
            self.robot.set_speed(8, 8)
            return
        self.face(counts)
        is_wall = self.width_deg() > WALL_DEG
        if is_wall and self.carrying:
            self.put_out()
        elif not is_wall and not self.carrying:
            self.pick_up()
        else:
            self.advance(-5, 0.4)
        self.turn(self.rng.uniform(60, 150) * self.rng.choice((-1, 1)))

    def face(self, counts: tuple[int, ...]) -> None:
        """Turn to the side of the largest count until a front sensor reads it."""
        side = 1 if int(np.argmax(counts)) <= 2 else -1
        end = self.robot.time + 6
        self.robot.set_speed(-3 * side, 3 * side)
        while int(np.argmax(self.robot.proximity()[:6])) not in (2, 3) and self.robot.time < end:
            pass
        self.robot.set_speed(0, 0)

    def width_deg(self) -> float:
        """Return the angle over which the front sensors detect the object ahead, and face its middle."""
        left = self.turn_until_lost(1)
        self.turn(-left)
        right = self.turn_until_lost(-1)
        self.turn(right + (left - right) / 2)
        return left + right

    def turn_until_lost(self, side: int) -> float:
        """Turn until the front sensors detect nothing, or by 80 degrees; return the angle [deg]."""
        self.robot.set_position(0, 0)
        self.robot.set_speed(-3 * side, 3 * side)
        turned = 0.0
        while max(self.robot.proximity()[2:4]) >= LOST and turned < 80:
            turned = 90 * abs(self.robot.position().right) / turn_pulses(np.pi / 2)
        self.robot.set_speed(0, 0)
        return 90 * abs(self.robot.position().right) / turn_pulses(np.pi / 2)

    def pick_up(self) -> None:
        """Approach, and close the fingers around an object that darkens the light barrier."""
        end = self.robot.time + 2
        self.robot.set_speed(2, 2)
        while max(self.robot.proximity()[2:4]) < 350 and self.robot.time < end:
            pass
        self.robot.set_speed(0, 0)
        self.gripper.lower()
        self.gripper.wait()
        end = self.robot.time + 3
        self.robot.set_speed(2, 2)
        while self.gripper.barrier() < DARK and self.robot.time < end:
            pass
        self.robot.set_speed(0, 0)
        if self.gripper.barrier() >= DARK:
            self.gripper.close()
            self.gripper.wait()
        thin = self.gripper.fingers() < THICK
        self.gripper.lift()
        self.gripper.wait()
        self.carrying = thin and self.gripper.barrier() >= DARK
        self.picked_up += self.carrying
        if not self.carrying:
            self.gripper.open()
            self.gripper.wait()
        self.advance(-5, 0.7)

    def put_out(self) -> None:
        """Push against the wall, reach over it and open the fingers."""
        self.advance(3, 2.0)
        self.gripper.move_arm(OVER_WALL)
        self.gripper.wait()
        self.gripper.open()
        self.gripper.wait()
        self.gripper.lift()
        self.gripper.wait()
        self.carrying = self.gripper.barrier() >= DARK
        self.advance(-5, 0.7)

    def advance(self, speed_pulses: int, seconds: float) -> None:
        """Drive straight for a time."""
        self.robot.set_speed(speed_pulses, speed_pulses)
        self.robot.sleep(seconds)
        self.robot.set_speed(0, 0)

    def turn(self, angle_deg: float) -> None:
        """Turn on the spot, as far as nothing is in the way."""
        with contextlib.suppress(MoveError):
            self.robot.turn(np.radians(angle_deg), timeout=8)


def outside(positions: np.ndarray) -> np.ndarray:
    """Return which cylinders are out of the arena (n,)."""
    return ((positions < 0) | (1000 * positions > SIDES_MM)).any(axis=1)


n_cylinders, results = len(ARENA.cylinders), []
for trial in range(options.trials):
    seed, poses, times, exits = options.seed + trial, [], [], []
    with Khepera(f"khep://garbage?seed={seed}") as robot:
        world = robot.port.twin.world  # the truth, for counting and drawing only
        bodies = [world.data.body(f"cylinder{index}") for index in range(n_cylinders)]
        collector = Collector(robot, stream(seed, "garbage"))
        out = np.zeros(n_cylinders, bool)
        while robot.time < options.seconds and not out.all():
            collector.cycle()
            poses.append(world.poses[0][:2])
            times.append(robot.time)
            positions = np.array([body.xpos[:2] for body in bodies])
            exits += positions[outside(positions) & ~out].tolist()
            out = outside(positions)
        print(
            f"seed {seed}: {collector.picked_up} picked up, {out.sum()} of {n_cylinders} put out "
            f"in {robot.time:.0f} s",
            flush=True,
        )
        results.append((collector.picked_up, out.sum(), robot.time))
    if options.picture and not trial:
        track = DrawnPath("khepera0", np.array(times), 1000 * np.array(poses))
        figure = draw(
            ARENA, [track], title="A trial; crosses: where cylinders left the arena", longer_side=4.8
        )
        # Some have rolled on by the end of the cycle in which they were put out.
        crosses = np.clip(1000 * np.array(exits).reshape(-1, 2), -30, np.add(SIDES_MM, 30))
        figure.axes[0].plot(*crosses.T, "x", ms=9, mew=2, color="#c0392b", zorder=8)
        figure.axes[0].set(xlim=(-50, SIDES_MM[0] + 50), ylim=(-50, SIDES_MM[1] + 50))
        save(figure, options.picture)
picked_up, put_out, seconds = np.mean(results, axis=0)
print(
    f"mean of {len(results)} trials: {picked_up:.1f} picked up, {put_out:.1f} of {n_cylinders} put out "
    f"in {seconds:.0f} s; {sum(out == n_cylinders for _, out, _ in results)} trials cleared the arena"
)
