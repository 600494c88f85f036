"""A log of version 1.0, whose scene is in protobuf and whose frames have other names."""

from pathlib import Path

import numpy as np
from log_contents import messages_of
from mcap.reader import make_reader

from khep_twin.lab.experiment.branch import BranchPlan, branch
from khep_twin.lab.experiment.repeat import repeat
from khep_twin.log.channels import TRANSFORMS
from khep_twin.log.decoding import decode
from khep_twin.log.reader import read_series
from khep_twin.log.recorded import BranchPoint, read_recorded_run
from khep_twin.log.viewer.replay import view

LOG = Path(__file__).parents[1] / "data" / "log_of_1_0.mcap"


def test_its_poses_are_read_and_its_run_repeats() -> None:
    poses = read_series(LOG).series["/khepera0/pose"].values
    recorded = [decode(TRANSFORMS, message.data)["transforms"][0] for _, message in messages_of(LOG, "/tf")]
    assert {transform["child_frame_id"] for transform in recorded} == {"khepera0/base"}
    assert np.allclose(poses[:, 0], [transform["transform"]["translation"]["x"] for transform in recorded])
    assert repeat(read_recorded_run(LOG)) is None


def test_it_is_shown(tmp_path: Path) -> None:
    view([LOG], tmp_path / "run.rrd")
    assert (tmp_path / "run.rrd").stat().st_size > 20_000


def test_a_branch_of_it_is_a_bag_of_one_encoding(tmp_path: Path) -> None:
    path = tmp_path / "branch.mcap"
    branch(BranchPlan(LOG, BranchPoint(300_000_000, seed=3)), path)
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert {channel.message_encoding for channel in summary.channels.values()} == {"cdr"}
    assert [message.log_time for _, message in messages_of(path, "/scene")] == [200_000_000]
    before, after = (read_series(log).series["/khepera0/pose"].values for log in (LOG, path))
    assert after[:16].tolist() == before[:16].tolist()
    assert len(after) == len(before)
