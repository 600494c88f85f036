"""Control algorithm in the form of the Khepera Toolbox's template: fill it in, and rename it.

    khep-twin run FILE.py:name --playpen obstacles --cycles 500 --runs 3 --save out/name
    khep-twin run FILE.py:name --port 2 --cycles 500
    python -i FILE.py, then: roborun2(name, port_id=2, cycles_per_run=500, runs=3)

It is called once for each run. For a simulated robot, write sim_sms, sim_rps and so on, and kheprom(btmap1)
at the end of each cycle. Unchanged, it wanders and turns away from obstacles.
"""

# All names of the toolbox are imported, as in Matlab.
# ruff: noqa: F403, F405

from numpy import array

from khep_twin.toolbox import *

# Initialize all your variables here; variables that persist from run to run are global.
Intercon = array([[4, -5], [4, -15], [6, -18], [-18, 6], [-15, 4], [-5, 4], [5, 3], [3, 5]])
speed = array([10, 10])


def name(port_id: int, cycles_per_run: int, runs: int, pause_stat: float) -> None:
    """Drive for `cycles_per_run` cycles; the values of the variables at the end are saved with the run."""
    run_count = 0
    while run_count < runs:
        cycle_count = 0
        while cycle_count < cycles_per_run:
            # ------------------------------------------------------
            # PLACE YOUR CODE HERE
            motors = (rps(port_id) @ Intercon) / 400 + speed
            sms(port_id, motors[0], motors[1])
            # ------------------------------------------------------
            cycle_count = cycle_count + 1
        # END OF RUN. EVERYTHING TO BE DONE BETWEEN RUNS SHOULD BE DONE HERE
        run_count = run_count + 1
    # PLACE ANY HOUSEKEEPING COMMANDS HERE (IE sms(2, 0, 0) TO STOP REAL KHEP)
    sms(port_id, 0, 0)
    cls(port_id, 0, 0)
