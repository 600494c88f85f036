"""Controller of a Khepera: a template to fill in.

    khep-twin run FILE.py --playpen obstacles --seconds 60
    khep-twin run FILE.py --port /dev/ttyUSB0 --cycles 500 --runs 3 --save out/series
    khep-twin series out/series

The same file drives a robot and a twin. Unchanged, it wanders and turns away from obstacles.
"""

from khep_twin import Controller, Khepera

SPEED_PULSES = 5  # [pulses/10 ms = 8 mm/s]
NEAR_COUNTS = 200  # proximity from 0, nothing there, to 1023, touching


class Wander(Controller):
    """Drive straight ahead; turn away from obstacles."""

    def start(self, robot: Khepera) -> None:
        """Set variables before the first cycle of each run. Their values at the end of the run are saved."""
        self.turns = 0  # saved with the run
        self._last = 0  # not saved: its name starts with _

    def cycle(self, robot: Khepera) -> None:
        """Read sensors, decide, drive; called once per cycle. Commands take time, N 45 ms at 9600 baud."""
        # Left 90, 45, 10 degrees, right 10, 45, 90, back right, back left: eight counts in this order.
        _, left_45, left_10, right_10, right_45, *_ = robot.proximity()
        # robot.ambient()    eight counts of light, about 500 in the dark, 50 in bright light
        # robot.position()   the wheels' counters [pulses of 0.08 mm]
        left, right = max(left_45, left_10), max(right_10, right_45)
        if max(left, right) < NEAR_COUNTS:
            turn = 0
        else:
            # To the right, if the obstacle is nearer at the left; a turn keeps its side, to leave corners.
            turn = self._last or (1 if left > right else -1)
        if turn and not self._last:
            self.turns += 1
        self._last = turn
        if turn:
            robot.set_speed(turn * SPEED_PULSES, -turn * SPEED_PULSES)
        else:
            robot.set_speed(SPEED_PULSES, SPEED_PULSES)

    def end(self, robot: Khepera) -> None:
        """Finish each run, after its last cycle and with the motors stopped."""

    def stop(self, robot: Khepera) -> None:
        """Clean up the robot at the end of the program, also after Ctrl-C or an error."""
        robot.set_led(0, 0)
