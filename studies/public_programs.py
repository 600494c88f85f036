"""Public programs for a robot's computer: `python -m studies public-programs FOLDER`.

FOLDER has a folder for each program with its executable `prog`, compiled for this computer with the options
that `khep-twin exec --cflags` prints, and, where they are needed, a file `arguments` and a file `typed` with
the input typed at its start. Each runs on the first robot with a computer of the playpen, for 600 simulated
seconds at a terminal, in a temporary folder, seeded with its index in the list. A row of the table has its
end, the robot's path length, the largest reading of the sensors around it, the size of the program's output,
and the speed.
"""

import math
import os
import pty
import shlex
import subprocess
import sys
import time
from pathlib import Path
from tempfile import TemporaryDirectory, TemporaryFile

from khep_twin.programs.computer import Machine
from khep_twin.programs.robot_program import RobotProgram, run_programs
from khep_twin.robots.robot import Robot
from khep_twin.world import World
from tools.command_table import command_line

_SAMPLE_NS = 100_000_000
"""Interval of samples of the robot [ns]."""


class TrackedTime:
    """Clock of a world that also records its robot's path.

    Attributes:
        path_m: Length of the robot's path [m].
        nearest: Largest reading of the infrared sensors around it.
    """

    def __init__(self, world: World, robot: Robot) -> None:
        self._world, self._robot = world, robot
        self._last_pose, self.path_m, self.nearest = robot.pose, 0.0, 0
        self._n_around = len(robot.robot_model.body.sensor_positions)

    @property
    def time_ns(self) -> int:
        """Time [ns]."""
        return self._world.time_ns

    def advance_to(self, time_ns: int) -> None:
        """Advance, and sample the robot at fixed intervals."""
        while (sample_ns := (self._world.time_ns // _SAMPLE_NS + 1) * _SAMPLE_NS) <= time_ns:
            self._world.advance_to(sample_ns)
            now = self._robot.pose
            self.path_m += math.dist(now[:2], self._last_pose[:2])
            self._last_pose = now
            near = max(self._robot.readings()["proximity"][: self._n_around])
            self.nearest = max(self.nearest, near)
        self._world.advance_to(time_ns)


def run(folder: Path, seconds: float, seed: int, playpen: str) -> str:
    """Run a program in this process, whose standard streams it replaces; return the row of the table."""
    world = World(playpen, seed=seed)
    robot = next(robot for robot in world.robots if "computer" in robot.robot_model.parts)
    clock, start_s = TrackedTime(world, robot), time.monotonic()
    leader, follower = pty.openpty()
    arguments, typed = folder / "arguments", folder / "typed"
    if typed.exists():
        os.write(leader, typed.read_bytes())
    words = shlex.split(arguments.read_text()) if arguments.exists() else []
    saved_stdout = os.dup(1)
    with TemporaryFile() as output:
        os.dup2(follower, 0)
        os.dup2(output.fileno(), 1)
        program = RobotProgram([str(folder / "prog"), *words], Machine(robot, clock))
        (code,) = run_programs([program], until_ns=round(seconds * 1e9))
        os.dup2(saved_stdout, 1)
        written = os.fstat(output.fileno()).st_size
    simulated_s = world.time_ns * 1e-9
    outcome = f"code {code}" if simulated_s < seconds else "still runs"
    wall_s = time.monotonic() - start_s
    x, y, heading = robot.pose
    return (
        f"| {folder.name} | {outcome} | {simulated_s:.1f} | {clock.path_m:.2f} | {x:.2f}, {y:.2f}, "
        f"{math.degrees(heading):.0f}° | {clock.nearest} | {written / 1000:.1f} | "
        f"{simulated_s / wall_s:.0f} |"
    )


def main() -> None:
    """Run all programs of a folder, each in a separate process."""
    parser = command_line(__doc__)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--playpen", default="arena4")
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--programs", nargs="*", metavar="NAME", help="only these")
    parser.add_argument("--here", metavar="NAME", help="this one, in this process")
    options = parser.parse_args()
    names = sorted(program.parent.name for program in options.folder.glob("*/prog"))
    if options.here:
        folder, playpen = (options.folder / options.here).resolve(), options.playpen
        if Path(playpen).is_file():
            playpen = str(Path(playpen).resolve())
        with TemporaryDirectory() as scratch:  # Programs write files into their working folder.
            os.chdir(scratch)
            print(run(folder, options.seconds, names.index(options.here), playpen), flush=True)
            os.chdir("/")
        return
    print("| program | end | s | m | pose | nearest | kB | x real time |\n|---|---|---|---|---|---|---|---|")
    for name in options.programs or names:
        command = [sys.executable, "-m", "studies", "public-programs", str(options.folder)]
        command += ["--seconds", str(options.seconds), "--playpen", options.playpen, "--here", name]
        process = subprocess.run(command, stdout=subprocess.PIPE, text=True, start_new_session=True)
        print(process.stdout.strip() or f"| {name} | failed: {process.returncode} |", flush=True)
