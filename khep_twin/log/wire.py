"""What a log needs to be repeated and compared: the hosts' acts, and the state in eight bytes.

    /khepera0/wire   std_msgs/Int64MultiArray   one act of the host, when the world came to know of it: what
                                                (0 sends, 1 hangs up, 2 takes back, 3 sets its line), from
                                                when on it holds [ns], baud and stop bits of the host's end
                                                (-1 for as the robot has it), then each byte
    /state           std_msgs/Int64MultiArray   hash of the whole world's state every 20 ms

The bytes are those that left the host; the transcript has what reached the robot.
"""

import struct
import zlib
from hashlib import blake2b

from khep_twin.log.channels import Encoder, read_array
from khep_twin.uart import Act, HostAct, LineSettings
from khep_twin.world import World

_LABEL = "act, at [ns], baud, stop bits, bytes"
_FRAME = Encoder().put("I", 1).text(_LABEL)
_FRAME.align(4)
_HEAD = _FRAME.message()
_PADDING = bytes(-(len(_HEAD) - 4 + 16) % 8)


def act_message(act: HostAct) -> bytes:
    """An act as a message of /khepera0/wire."""
    # Written by hand, as there is one for every command of the host.
    baud, stop_bits = (act.host.baud, act.host.stop_bits) if act.host is not None else (-1, -1)
    length = 4 + len(act.data)
    layout = struct.pack("<4I", length, length, 0, length)
    return b"".join(
        (
            _HEAD,
            layout,
            _PADDING,
            struct.pack(f"<{length}q", act.kind, act.at_ns, baud, stop_bits, *act.data),
        )
    )


def read_act(message: bytes) -> HostAct:
    """An act from its message."""
    kind, at_ns, baud, stop_bits, *data = map(int, read_array(message, "q"))
    host = None if baud < 0 else LineSettings(baud, stop_bits)
    return HostAct(Act(kind), at_ns, host, bytes(data))


class StateHash:
    """The state of a world in eight bytes: its physics, its boards, and all that was answered so far."""

    def __init__(self, world: World) -> None:
        self._sources = [world.data.qpos.data, world.data.qvel.data]
        for robot in world.robots:
            boards = (robot.registers, *(each.registers for each in robot.firmware.turrets.values()))
            self._sources += [board.data for board in boards]
        # Each robot's for itself: which of two was heard first within a step depends on who asked when.
        self._answered = [0] * len(world.robots)

    def hear(self, time_ns: int, robot: int, data: bytes) -> None:
        """Takes bytes that a robot has answered."""
        self._answered[robot] = zlib.crc32(b"%d " % time_ns + data, self._answered[robot])

    def value(self) -> int:
        """The hash as of now, a number of 64 bits with sign."""
        state = blake2b(struct.pack(f"<{len(self._answered)}I", *self._answered), digest_size=8)
        for source in self._sources:
            state.update(source)
        return int.from_bytes(state.digest(), "little", signed=True)
