"""Two robots and a cylinder: one finds it and sends its position by radio, the other fetches and lifts it.

python examples/07_baton.py              both twins in this process, in lock-step
python examples/07_baton.py baton.mcap   the same with a log, for `khep-twin view baton.mcap`
"""

import math
import struct
import sys
from pathlib import Path

from khep_twin import Gripper, Khepera, Radio, TwinOptions
from khep_twin.lab.experiment import run_together

PLAYPEN = Path(__file__).with_suffix(".toml")
SCOUT, PORTER = 1, 2  # numbers of their radios: robots of the playpen, from 1
LANES_MM = ((80, 180), (520, 180), (520, 320), (80, 320))  # the scout's way, from its start on
PORTER_MM = (60, 440)  # the porter's start; both face along x
DETECTION = 150  # counts of a sensor with the cylinder about 2 cm away
NEAR = 400  # counts of the front sensors about a centimetre from it
BALANCED = 150  # difference of the counts on both sides with something straight ahead
DISTANCE_MM = 27.5 + 10 + 12.5  # between the centres then: half a robot, the gap, half the cylinder
PULSE_MM, WHEEL_BASE_MM = 0.08, 52


class Walker:
    """A robot with odometry: its pose from the start and the turns of its wheels."""

    def __init__(self, robot: Khepera, x_mm: float, y_mm: float) -> None:
        self.robot, self.x_mm, self.y_mm, self.heading = robot, x_mm, y_mm, 0.0
        self._before = robot.position()

    def update(self) -> None:
        """Add the path since the last update, an arc."""
        now = self.robot.position()
        left, right = ((new - old) * PULSE_MM for new, old in zip(now, self._before, strict=True))
        self._before = now
        bend = (right - left) / WHEEL_BASE_MM
        self.x_mm += (left + right) / 2 * math.cos(self.heading + bend / 2)
        self.y_mm += (left + right) / 2 * math.sin(self.heading + bend / 2)
        self.heading += bend

    def face(self, x_mm: float, y_mm: float) -> float:
        """Turn towards a position; return its distance [mm]."""
        self.update()
        x, y = x_mm - self.x_mm, y_mm - self.y_mm
        self.robot.turn(math.remainder(math.atan2(y, x) - self.heading, math.tau))
        self.update()
        return math.hypot(x, y)

    def search(self, distance_mm: float) -> bool:
        """Drive straight ahead until a sensor detects an object; return whether one did."""
        x_mm, y_mm = self.x_mm, self.y_mm
        self.robot.set_speed(6, 6)
        while not (sees := max(self.robot.proximity()[:6]) > DETECTION):
            self.update()
            if math.hypot(self.x_mm - x_mm, self.y_mm - y_mm) >= distance_mm:
                break
        self.robot.set_speed(0, 0)
        self.update()
        return sees

    def approach(self) -> None:
        """Turn to the detected object and drive up to it."""
        while True:
            near = self.robot.proximity()
            aside = near.left_90 + near.left_45 + near.left_10
            aside -= near.right_10 + near.right_45 + near.right_90
            if abs(aside) > BALANCED:
                self.robot.set_speed(*((-1, 1) if aside > 0 else (1, -1)))
            elif max(near.left_10, near.right_10) > NEAR:
                break
            else:
                self.robot.set_speed(2, 2)
            self.update()
        self.robot.set_speed(0, 0)
        self.update()


def scout(robot: Khepera) -> str:
    """Search along the lanes; send the cylinder's position, and wait for an answer."""
    radio, walker = Radio(robot), Walker(robot, *LANES_MM[0])
    for x_mm, y_mm in LANES_MM[1:]:
        if walker.search(walker.face(x_mm, y_mm)):
            break
    else:
        return "scout: found nothing"
    walker.approach()
    x_mm = round(walker.x_mm + DISTANCE_MM * math.cos(walker.heading))
    y_mm = round(walker.y_mm + DISTANCE_MM * math.sin(walker.heading))
    robot.move(-0.08)  # out of the porter's way
    radio.send(PORTER, struct.pack("<hh", x_mm, y_mm))
    if not radio.wait_until_sent():
        return "scout: nobody heard me"
    answer = radio.wait_for_message(timeout=60).data.decode()
    return f"scout: found it at ({x_mm}, {y_mm}) mm; the porter says {answer!r}"


def porter(robot: Khepera) -> str:
    """Wait for a message, drive to its position and lift the cylinder."""
    radio, gripper, walker = Radio(robot), Gripper(robot), Walker(robot, *PORTER_MM)
    x_mm, y_mm = struct.unpack("<hh", radio.wait_for_message(timeout=120).data)
    start = robot.time
    walker.search(walker.face(x_mm, y_mm))
    walker.approach()

    gripper.lower()
    gripper.wait()
    end = robot.time + 5
    robot.set_speed(2, 2)
    while gripper.barrier() < 200 and robot.time < end:
        pass
    robot.set_speed(0, 0)
    gripper.close()
    gripper.wait()
    gripper.lift()
    gripper.wait()
    answer = "lifted" if gripper.barrier() else "missed"
    radio.send(SCOUT, answer.encode())
    radio.wait_until_sent()
    return f"porter: {answer} it {robot.time - start:.1f} s after the message"


options = TwinOptions(seed=1, log=sys.argv[1] if len(sys.argv) > 1 else None)
for line in run_together(PLAYPEN, [scout, porter], options):
    print(line)
