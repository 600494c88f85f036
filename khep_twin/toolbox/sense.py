"""The Khepera Toolbox's sensor tests without windows: `tstsense` at a port, `simsense` in the simulator.

    dv, khep_pos = tstsense(2, "light", linear_cm=55, return_to_zero=True, save="lamp.mat")
    putkhep(300, 400, 90)
    dv, khep_pos = simsense(rotate_deg=360)
    ddrg(dv, khep_pos)

`khep-twin sense` does the same from the command line.
"""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from khep_twin.errors import SensorTestError
from khep_twin.files.paths import StrPath
from khep_twin.host import Khepera
from khep_twin.lab.sensor_test import sensor_files
from khep_twin.lab.sensor_test.sensor_test import (
    DEFAULT_ACCELERATION,
    DEFAULT_SPEED,
    BrokenOffError,
    InterruptedTest,
    QuantityName,
    SensorRun,
    SensorTest,
    sense,
)
from khep_twin.renamed import renamed_arguments
from khep_twin.toolbox.serial_commands import Port, robot_at
from khep_twin.toolbox.simulator import get_open_playpen

EXCHANGE_S = 0.03
"""Duration of an exchange in `simsense` [s] (assumed: about the mean of H and N at 9600 baud)."""

_latest_run: list[SensorRun] = []
"""Readings of the latest test."""


@renamed_arguments(what="quantity")
def tstsense(
    port_id: Port,
    quantity: QuantityName = "proximity",
    *,
    linear_cm: float | None = None,
    rotate_deg: float | None = None,
    max_speed: int = DEFAULT_SPEED,
    max_acc: int = DEFAULT_ACCELERATION,
    return_to_zero: bool = False,
    save: StrPath | None = None,
    dlgstr: str = "",
) -> tuple[NDArray[np.int64], int]:
    """Drive a robot straight or turn it, and read its sensors on the way.

    Ctrl-C, a blocked wheel or a lost connection ends the test: the motors stop, and `save` and `lasttest()`
    contain the rows so far.

    Args:
        port_id: Port of the robot.
        quantity: "proximity" or "light".
        linear_cm: Distance, 5 to 60 forwards, negative backwards [cm].
        rotate_deg: Angle to turn on the spot instead, 15 to 360, negative for clockwise [degrees].
        max_speed: Speed of both wheels [pulses/10 ms].
        max_acc: Acceleration of both wheels [3.125 mm/s^2].
        return_to_zero: Wait 5 s at the end and drive back.
        save: MAT file with `dv` and `dlgstr`, or a CSV or MCAP file, to write.
        dlgstr: Description to save with the data.

    Returns:
        `dv` (n, 10), two position counters and eight sensors per reading, and `khep_pos`, the target distance
        of a wheel [pulses].

    Raises:
        SensorTestError: The arguments are invalid, or a wheel is blocked.
        KhepTwinError: The file cannot be written.
    """
    test = SensorTest(quantity, linear_cm, rotate_deg, max_speed, max_acc, return_to_zero)
    return _run_test(robot_at(port_id), test, save, dlgstr)


@renamed_arguments(what="quantity")
def simsense(
    quantity: QuantityName = "proximity",
    *,
    linear_cm: float | None = None,
    rotate_deg: float | None = None,
    max_speed: int = DEFAULT_SPEED,
    max_acc: int = DEFAULT_ACCELERATION,
    return_to_zero: bool = False,
    save: StrPath | None = None,
    dlgstr: str = "",
    port_id: int = 1,
) -> tuple[NDArray[np.int64], int]:
    """Run the test of `tstsense` with a robot of the playpen that is open, in simulated time.

    Raises:
        PlaypenError: No playpen is open.
        SensorTestError: The arguments are invalid, or a wheel is blocked.
        KhepTwinError: The file cannot be written.
    """
    test = SensorTest(quantity, linear_cm, rotate_deg, max_speed, max_acc, return_to_zero)
    simulator = get_open_playpen()
    robot = Khepera(simulator.robots[simulator.index(port_id)].port)
    # An exchange takes time here; without it, all readings would be at one position.
    robot.listen(lambda request, reply: robot.sleep(EXCHANGE_S))
    return _run_test(robot, test, save, dlgstr)


def lasttest() -> tuple[NDArray[np.int64], int]:
    """Return `dv` and `khep_pos` of the latest test, complete or interrupted.

    Raises:
        SensorTestError: There was no test.
    """
    if not _latest_run:
        raise SensorTestError("there was no test yet; expected tstsense or simsense before")
    return _latest_run[-1].dv, abs(_latest_run[-1].test.target[1])


def find_test(dv: object) -> SensorTest | None:
    """Return the latest test if it returned `dv`."""
    return _latest_run[-1].test if _latest_run and _latest_run[-1].dv is dv else None


def _run_test(
    robot: Khepera, test: SensorTest, save: StrPath | None, dlgstr: str
) -> tuple[NDArray[np.int64], int]:
    if save is not None:
        sensor_files.check_suffix(Path(save))  # before the robot moves
    try:
        _store_run(sense(robot, test, text=dlgstr), save)
    except (BrokenOffError, InterruptedTest) as error:
        _store_run(error.run, save)
        raise
    return lasttest()


def _store_run(run: SensorRun, save: StrPath | None) -> None:
    """Store the readings of a test, also in a file if one is given."""
    _latest_run[:] = [run]
    if save is not None and len(run.dv):
        sensor_files.save(Path(save), run)
