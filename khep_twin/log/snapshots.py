"""Snapshots in a log, from which its run can be resumed at any moment.

    /snapshot   std_msgs/UInt8MultiArray   state of the world and of its recorder, every 10 s and at the end

A snapshot is the last message of a piece of the log: host events in later messages are those that follow it.
Replies that have reached the host are left out, since the log does not have when the host reads them.
"""

from typing import Annotated, NamedTuple

from pydantic import Base64UrlBytes, Field

from khep_twin.clock import NS_PER_S
from khep_twin.log.channels import bytes_message
from khep_twin.log.decoding import read_array
from khep_twin.simulation.snapshot_format import pack, unpack
from khep_twin.simulation.world_state import WorldState
from khep_twin.world import World

TOPIC = "/snapshot"

SNAPSHOT_NS = 10 * NS_PER_S
"""Time between two snapshots [ns]."""


class RecorderState(NamedTuple):
    """State of a recorder.

    Attributes:
        answered: Hash of the answers of each robot.
        rests: Incomplete lines of the transcripts: robot, whether to the robot, bytes.
        lamps_sets: Number of sets of lamps so far.
        lamps_change: Whether the powers of the present ones are recorded.
    """

    answered: tuple[Annotated[int, Field(ge=0, lt=2**32)], ...]
    rests: tuple[tuple[Annotated[int, Field(ge=0)], bool, Base64UrlBytes], ...]
    lamps_sets: Annotated[int, Field(ge=1, le=10**6)]
    lamps_change: bool


class LoggedState(NamedTuple):
    """State of a world and of its recorder."""

    world: WorldState
    recorder: RecorderState


def snapshot_message(world: World, recorder: RecorderState) -> bytes:
    """Return the message of a world between two steps."""
    state = LoggedState(world.state(since_ns=world.time_ns), recorder)
    return bytes_message(pack(state, world.scene), "state, as khep_twin.log.snapshots has it")


def read_snapshot(message: bytes, scene: str | None) -> LoggedState:
    """Return the state of a message.

    Args:
        message: Message of /snapshot.
        scene: Fingerprint of the scene that it has to be of; None for any.

    Raises:
        DecodeError: It is no such message.
        SnapshotError: It is no snapshot, or of another version or scene.
    """
    return unpack(bytes(read_array(message, "B")), LoggedState, scene)
