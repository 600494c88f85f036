"""Poses of bodies, decoded together."""

from pathlib import Path

import numpy as np
import pytest
from driving import SECOND

from khep_twin.log.channels import TransformFrame
from khep_twin.log.decoding import DecodeError
from khep_twin.log.reader import read_log, read_raw
from khep_twin.log.transforms import compose, invert, relative, world_poses
from khep_twin.ports.twin import TwinOptions, open_twin

TIMES_NS = np.array([0, SECOND])


def messages(frames: list[tuple[str, str]], poses: np.ndarray) -> list[bytes]:
    return [row.tobytes() for row in TransformFrame(frames).messages(TIMES_NS, poses)]


def random_poses(n: int) -> np.ndarray:
    poses = np.random.default_rng(1).normal(size=(2, n, 7))
    poses[..., 3:] /= np.linalg.norm(poses[..., 3:], axis=-1, keepdims=True)
    return poses


def test_the_pose_of_a_frame_is_in_the_root_frame_whatever_its_parents() -> None:
    poses = random_poses(3)
    world = world_poses(
        messages([("arm", "finger"), ("map", "base"), ("base", "arm")], poses), {"base", "arm", "finger"}
    )
    assert np.allclose(world["base"], poses[:, 1])
    arm = compose(poses[:, 1], poses[:, 2])
    assert np.allclose(world["finger"], compose(arm, poses[:, 0]))
    assert np.allclose(relative(world["finger"], world["arm"]), poses[:, 0])
    assert np.allclose(compose(invert(arm), arm), [0, 0, 0, 0, 0, 0, 1])


def test_messages_of_other_sizes_are_decoded_one_by_one_and_other_frames_refused() -> None:
    poses = random_poses(1)
    first, last = messages([("map", "base")], poses)
    (other, _), (longer, _) = messages([("map", "arm_")], poses), messages([("map", "arms_of")], poses)
    for forged in (other, longer):
        with pytest.raises(DecodeError, match="expected those of the channel's first message"):
            world_poses([first, last, forged], {"base"})
    with pytest.raises(DecodeError, match="circle"):
        world_poses(messages([("a", "b"), ("b", "a")], random_poses(2)), {"a"})
    with pytest.raises(DecodeError):
        world_poses([first[:-8]], {"base"})


def test_the_poses_of_robots_are_those_of_the_reader(tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    with open_twin("obstacles", TwinOptions(seed=3, log=str(path))) as twin:
        twin.robot.send(b"D,8,5\n")
        twin.advance_to(SECOND // 5)
    _, by_topic, _ = read_raw(path, lambda topic: topic == "/tf")
    name = "khepera0/base"
    poses = world_poses([data for _, data in by_topic["/tf"]], {name})
    assert np.allclose(poses[name][:, :2], read_log(path).robots["khepera0"].pose[:, :2])
