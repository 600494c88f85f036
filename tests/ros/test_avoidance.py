"""A robot that another library drives by its scan alone, in another process."""

from pathlib import Path

import numpy as np
import pytest
from ros_network import DOMAIN, ForeignNode, assert_soon
from served_twin import served

from khep_twin.lab.experiment.run_statistics import clearance
from khep_twin.log.reader import read_series
from khep_twin.playpen import Playpen
from khep_twin.ros.graph import Graph

SHARE = 6.0
"""Time of a drive in the suite [s]."""


def drive(router: Graph, foreign: ForeignNode, port: str, seconds: float, *options: str) -> None:
    """Show the robot at a port as a node, and have the other process drive it."""
    network = f"--router={router.address}", f"--domain={DOMAIN}"
    with served(port, *network, *options, command="ros"):
        assert_soon(lambda: "/khepera0/cmd_vel" in foreign.topics(), True)
        for _ in range(round(seconds / SHARE)):
            n_scans = foreign.avoid(robot="khepera0", seconds=SHARE, steps="--paused" in options)
            assert n_scans > 3 * SHARE


def check(log: Path, seconds: float) -> None:
    """Check that the robot went a way and touched nothing."""
    poses = read_series(log).series["/khepera0/pose"].values
    way = np.hypot(*np.diff(poses[:, :2], axis=0).T).sum()
    assert way > 0.02 * seconds
    touches = clearance(poses[:, :2], Playpen.load("obstacles")) < 0.028
    assert touches.mean() < 0.02


def test_a_twin_is_driven_by_its_scan_in_steps(router: Graph, foreign: ForeignNode, tmp_path: Path) -> None:
    log = tmp_path / "run.mcap"
    drive(router, foreign, f"khep://obstacles?seed=3&unpaced=on&log={log}", SHARE, "--paused", "--rate=10")
    check(log, SHARE)


@pytest.mark.long
def test_a_twin_is_driven_by_its_scan_for_a_minute(
    router: Graph, foreign: ForeignNode, tmp_path: Path
) -> None:
    log = tmp_path / "run.mcap"
    drive(router, foreign, f"khep://obstacles?seed=3&log={log}", 60.0)
    check(log, 60.0)


@pytest.mark.long
def test_a_robot_at_a_terminal_is_driven_by_its_scan_for_a_minute(
    router: Graph, foreign: ForeignNode, tmp_path: Path
) -> None:
    log = tmp_path / "run.mcap"
    with served("obstacles", "--link", str(tmp_path / "robot"), "--log", str(log)) as (_, port):
        drive(router, foreign, port, 60.0)
    check(log, 60.0)
