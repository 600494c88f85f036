"""The Khepera Toolbox's second example for its simulator: the first one with khepbase.

python simsamp2.py                                     a window with the robot's bars, or khepbase.png
khep-twin run simsamp2.py:simsamp2 --cycles 300        as an experiment

It goes ahead until a sensor sees something near, then turns.
"""

# All names of the toolbox are imported together, as in Matlab.
# ruff: noqa: F403, F405

from khep_twin.toolbox import *

btmap1 = open_default(seed=1)


def simsamp2(port_id, cycles_per_run, runs, pause_stat):
    khepbase()
    run_count = 0
    while run_count < runs:
        cycle_count = 0
        while cycle_count < cycles_per_run:
            sim_sms(2, 5, 5)
            a = sim_rps(2)
            if any(a > 900):
                sim_sms(2, -5, 5)
            kheprom(btmap1)
            khepbase(sim_rps(2), sim_rls(2), sim_rms(2))
            cycle_count = cycle_count + 1
        run_count = run_count + 1
    sim_sms(2, 0, 0)


if __name__ == "__main__":
    simsamp2(2, 200, 1, 0)
