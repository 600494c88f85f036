"""Controller of a Khepera IV: a template to fill in.

    khep-twin run FILE.py --playpen arena4 --seconds 60
    khep-twin run FILE.py --port /dev/rfcomm0 --seconds 60

The same file drives a robot and a twin. Unchanged, it wanders and turns away from obstacles.
"""

from khep_twin import Controller, Khepera4

SPEED = 0.2  # [m/s]
NEAR_COUNTS = 200  # proximity from about 100, nothing there, to 1020, touching


class Wander(Controller):
    """Drive straight ahead; turn away from obstacles."""

    def start(self, robot: Khepera4) -> None:
        """Set variables before the first cycle of each run. Their values at the end of the run are saved."""
        self.turns = 0  # saved with the run
        self._last = 0  # not saved: its name starts with _

    def cycle(self, robot: Khepera4) -> None:
        """Read sensors, decide, drive; called once per cycle."""
        near = robot.proximity()  # counts: left, front_left, front, ..., back, ground_left, ..., ground_right
        # robot.ultrasonic()  distances [m]: left, front_left, front, front_right, right
        # robot.ambient()     counts of light as in proximity, about 980 in the dark
        # robot.position()    ways of the wheels [m]: left, right
        if max(near.front_left, near.front, near.front_right) < NEAR_COUNTS:
            turn = 0
        else:
            # To the right, if the obstacle is nearer at the left; a turn keeps its side, to leave corners.
            turn = self._last or (1 if near.front_left > near.front_right else -1)
        if turn and not self._last:
            self.turns += 1
        self._last = turn
        if turn:
            robot.set_speed(turn * SPEED, -turn * SPEED)
        else:
            robot.set_speed(SPEED, SPEED)

    def stop(self, robot: Khepera4) -> None:
        """Clean up the robot at the end of the program, also after Ctrl-C or an error."""
        robot.set_leds((0, 0, 0), (0, 0, 0), (0, 0, 0))
