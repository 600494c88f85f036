"""The toolbox's sensor tests, at a port and in its simulator."""

from pathlib import Path

import numpy as np
import pytest
from scipy.io import loadmat

from khep_twin import toolbox
from khep_twin.errors import PlaypenError, PortError, SensorTestError
from khep_twin.host import Khepera
from khep_twin.host.results import SensorCounts
from khep_twin.lab.sensor_test.sensor_test import BrokenOffError
from khep_twin.toolbox import serial_commands as host


def test_the_simulated_robot_is_tested_where_it_was_put() -> None:
    btmap1 = toolbox.open_default(noise=False)
    toolbox.putkhep(300, 400, 90)
    dv, khep_pos = toolbox.simsense(linear_cm=7, max_speed=8)
    assert khep_pos == 875
    assert dv[0, :2].tolist() == [0, 0]
    assert dv[-1, :2] == pytest.approx([875, 875], abs=2)
    # At the end it is 2.5 mm before the wall; its rear sensors detect nothing.
    assert dv[-1, 4:6].min() > 900
    assert dv[:, 8:].max() < 30
    assert btmap1.twin.robot.pose[1] == pytest.approx(0.47, abs=1e-3)
    assert toolbox.sim_rms(1).tolist() == [0, 0]


def test_a_turn_is_driven_back() -> None:
    btmap1 = toolbox.open_default(noise=False)
    dv, khep_pos = toolbox.simsense("light", rotate_deg=-90, return_to_zero=True)
    assert khep_pos == 511
    assert dv[-1, :2] == pytest.approx([511, -511], abs=2)
    assert np.unique(dv[:, 2:]).tolist() == [485]
    assert np.degrees(btmap1.twin.robot.pose[2]) == pytest.approx(90, abs=1)
    assert btmap1.time > 5


def test_a_robot_at_a_port_is_tested_and_its_data_saved(tmp_path: Path) -> None:
    file = tmp_path / "light.mat"
    host.ports({2: "khep://two-lamps?noise=off"})
    dv, khep_pos = toolbox.tstsense(2, "light", rotate_deg=45, save=file, dlgstr="two lamps")
    saved = loadmat(file)
    assert saved["dv"].tolist() == dv.tolist()
    assert saved["dlgstr"].tolist() == ["two lamps"]
    assert khep_pos == 255


class Interrupted(Khepera):
    """A robot whose user presses Ctrl-C, or whose line fails, after a number of readings."""

    readings_left, failure = 12, KeyboardInterrupt()

    def proximity(self) -> SensorCounts:
        """Read, or raise the failure."""
        self.readings_left -= 1
        if self.readings_left == 0:
            raise self.failure
        return super().proximity()


@pytest.mark.parametrize("failure", [KeyboardInterrupt(), PortError("the line is gone")])
def test_an_interrupted_test_keeps_what_it_has(failure: BaseException, tmp_path: Path) -> None:
    robot = Interrupted("khep://default?noise=off")
    robot.failure = failure  # type: ignore[assignment]
    with pytest.raises((KeyboardInterrupt, BrokenOffError)) as caught:
        toolbox.tstsense(robot, linear_cm=15, save=tmp_path / "so_far.mat")
    assert len(loadmat(tmp_path / "so_far.mat")["dv"]) == 11
    dv, khep_pos = toolbox.lasttest()
    assert (len(dv), khep_pos) == (11, 1875)
    assert caught.value.run.dv is dv  # type: ignore[union-attr]
    robot.sleep(1)
    assert robot.speed() == (0, 0)


def test_what_is_no_test_moves_nothing() -> None:
    with pytest.raises(PlaypenError, match="no playpen is open"):
        toolbox.simsense(linear_cm=10)
    btmap1 = toolbox.open_default()
    with pytest.raises(SensorTestError, match="linear = 70 cm"):
        toolbox.simsense(linear_cm=70)
    with pytest.raises(SensorTestError, match=r"expected a name that ends in \.csv"):
        toolbox.simsense(linear_cm=10, save="data.txt")
    assert btmap1.time == 0
