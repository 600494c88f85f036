"""The Khepera Toolbox's first example, typed over from Matlab: a Braitenberg vehicle.

KHEP_PORT_2=/dev/ttyUSB0 python brait.py              a robot
KHEP_PORT_2=khep://obstacles python brait.py          a twin in this process

It drives until Ctrl-C.
"""

# All names of the toolbox are imported together, as in Matlab.
# ruff: noqa: F403, F405

from numpy import array

from khep_twin.toolbox.serial_commands import *

loopvar = 0
Intercon = array([[4, -5], [4, -15], [6, -18], [-18, 6], [-15, 4], [-5, 4], [5, 3], [3, 5]])
speed = array([10, 10])
while loopvar == 0:
    motors = (rps(2) @ Intercon) / 400 + speed
    sms(2, motors[0], motors[1])
