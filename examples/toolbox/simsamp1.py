"""The Khepera Toolbox's example for its simulator, typed over from Matlab into its template for RoboRunner.

python simsamp1.py                                     a twin, as long as 2 runs of 500 cycles take
khep-twin run simsamp1.py:simsamp1 --cycles 500        the same as an experiment

It goes ahead until a sensor sees something near, then turns. docs/toolbox.md makes it a program for a robot.
"""

# All names of the toolbox are imported together, as in Matlab.
# ruff: noqa: F403, F405

from khep_twin.toolbox import *

btmap1 = open_default(seed=1)


def simsamp1(port_id, cycles_per_run, runs, pause_stat):
    run_count = 0
    while run_count < runs:
        cycle_count = 0
        while cycle_count < cycles_per_run:
            sim_sms(2, 1, 1)
            a = sim_rps(2)
            if any(a > 900):
                sim_sms(2, -1, 1)
            kheprom(btmap1)
            cycle_count = cycle_count + 1
        run_count = run_count + 1
    sim_sms(2, 0, 0)


if __name__ == "__main__":
    simsamp1(2, 500, 2, 0)
