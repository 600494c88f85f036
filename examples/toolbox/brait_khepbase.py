"""The same vehicle with khepbase, as the Khepera Toolbox's manual shows it: the robot's bars in each cycle.

KHEP_PORT_2=khep://obstacles python brait_khepbase.py

Without a screen, khepbase.png is rewritten each time. The manual's program reads the light twice, although
its comment names proximity; this one reads both.
"""

# All names of the toolbox are imported together, as in Matlab.
# ruff: noqa: F403, F405

from numpy import array

from khep_twin.toolbox import *

khepbase()
loopvar = 0
Intercon = array([[4, -5], [4, -15], [6, -18], [-18, 6], [-15, 4], [-5, 4], [5, 3], [3, 5]])
speed = array([10, 10])
while loopvar == 0:
    motors = (rps(2) @ Intercon) / 400 + speed
    sms(2, motors[0], motors[1])
    ld = rls(2)  # light data
    pd = rps(2)  # proximity data
    khepbase(pd, ld, speed)  # update the display
