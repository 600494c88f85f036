"""Complete state of the world in a log: hashes to compare runs, and snapshots to resume them.

    /state      std_msgs/Int64MultiArray   a hash of eight bytes every 20 ms from the message's time on
    /snapshot   std_msgs/UInt8MultiArray   state of the world and of its recorder, every 10 s and at the end

A snapshot is the last message of a flush of the log: host events in later messages follow it. Replies that
have reached the host are omitted, since the log does not contain the times at which the host reads them.
"""

import zlib
from functools import cache
from typing import Annotated, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Base64UrlBytes, Field

from khep_twin.clock import NS_PER_S
from khep_twin.log.channels import array_message, bytes_message
from khep_twin.log.decoding import LATEST_NS, read_array
from khep_twin.robots.robot import Robot
from khep_twin.simulation.snapshot_format import pack, unpack
from khep_twin.simulation.world_state import WorldState
from khep_twin.world import World

SNAPSHOT_TOPIC = "/snapshot"

SNAPSHOT_NS = 10 * NS_PER_S
"""Time between two snapshots [ns]."""


class RecorderState(NamedTuple):
    """State of a recorder.

    Attributes:
        answered: Hash of the replies of each robot.
        rests: Incomplete lines of the transcripts: robot, whether to the robot, bytes.
        lamps_sets: Number of sets of lamps so far.
        lamps_change: Whether the powers of the present set are recorded.
        early_lines: Complete lines that end later: time [ns], robot, whether to the robot, bytes.
    """

    answered: tuple[Annotated[int, Field(ge=0, lt=2**32)], ...]
    rests: tuple[tuple[Annotated[int, Field(ge=0)], bool, Base64UrlBytes], ...]
    lamps_sets: Annotated[int, Field(ge=1, le=10**6)]
    lamps_change: bool
    early_lines: tuple[
        tuple[Annotated[int, Field(ge=0, le=LATEST_NS)], Annotated[int, Field(ge=0)], bool, Base64UrlBytes],
        ...,
    ] = ()


class LoggedState(NamedTuple):
    """State of a world and of its recorder."""

    world: WorldState
    recorder: RecorderState


def snapshot_message(world: World, recorder: RecorderState) -> bytes:
    """Return the message of a world between two steps."""
    state = LoggedState(world.state(since_ns=world.time_ns), recorder)
    return bytes_message(pack(state, world.scene), "state, as khep_twin.log.snapshots has it")


def read_snapshot(message: bytes, scene: str | None) -> LoggedState:
    """Return the state of a message; its scene must have the fingerprint `scene`, None for any.

    Raises:
        DecodeError: The bytes are no message of this type.
        SnapshotError: The message is no snapshot, or of another version or scene.
    """
    return unpack(bytes(read_array(message, "B")), LoggedState, scene)


def states_message(states: NDArray[np.int64]) -> bytes:
    """Return hashes of consecutive samples as a message of /state."""
    return array_message(states, "hash of the state every 20 ms")


def read_states(message: bytes) -> list[int]:
    """Return hashes of consecutive samples from their message."""
    return list(read_array(message, "q"))


def board_registers(robot: Robot) -> list[NDArray[np.int64]]:
    """Return the registers of a robot's board, then of each turret."""
    return [robot.registers, *(turret.registers for turret in robot.firmware.turrets.values())]


class ReplyHashes:
    """Running hash of all replies of each robot, in `values`."""

    def __init__(self, n_robots: int) -> None:
        # One per robot: the order of two robots within a step depends on which host reads first.
        self.values = [0] * n_robots

    def on_bytes(self, time_ns: int, robot: int, data: bytes) -> None:
        """Add bytes of a robot's reply."""
        self.values[robot] = zlib.crc32(b"%d " % time_ns + data, self.values[robot])


def hash_samples(*parts: NDArray[np.int64] | NDArray[np.float64]) -> NDArray[np.int64]:
    """Return a hash of eight bytes for each sample of a state (n,).

    The hash is the sum modulo 2^64 of all words, each times a different odd number: it detects any change of
    one word, and all but one in 2^64 changes of several words.

    Args:
        parts: Parts of the state, one row for each sample (n, length): hashes of replies, positions and
            speeds, and the registers of every robot's boards.
    """
    words = np.hstack([np.ascontiguousarray(part).view(np.uint64) for part in parts])
    # The highest bit of a word, the sign of a float, would only affect the highest bit of the sum.
    words ^= words >> np.uint64(32)
    return (words @ _odd_numbers(words.shape[1])).view(np.int64)


@cache
def _odd_numbers(count: int) -> NDArray[np.uint64]:
    """Return odd pseudorandom numbers (count,): the finalizer of splitmix64 over 1, 2, 3, ..."""
    numbers = np.arange(1, count + 1, dtype=np.uint64) * np.uint64(0x9E3779B97F4A7C15)
    for shift, factor in ((30, 0xBF58476D1CE4E5B9), (27, 0x94D049BB133111EB), (31, 1)):
        numbers = (numbers ^ (numbers >> np.uint64(shift))) * np.uint64(factor)
    return numbers | np.uint64(1)
