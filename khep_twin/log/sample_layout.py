"""Layout of a sample, and the channels whose numbers it contains.

A sample is a copy of all variables of a world, eight bytes per number, which is fast; derived quantities are
computed for many samples together. Its columns:

    | qpos | qvel | robot 0: board, turrets | robot 1 ... | xpos | xquat |
    |<------------------- state ------------------------>|<-- bodies -->|

The hashes cover the state. Positions and rotations of the bodies are derived from it. Powers of lamps that
change are recorded in a separate channel.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from itertools import accumulate

import numpy as np
from numpy.typing import NDArray

from khep_twin.log.channels import (
    FLOATS,
    IMAGE,
    INTEGERS,
    ArrayFrame,
    ImageFrame,
    text_message,
)
from khep_twin.log.frames import MovingBodies
from khep_twin.log.snapshots import RecorderState, board_registers
from khep_twin.robots.model import SampledRegisters
from khep_twin.robots.robot import Robot
from khep_twin.sensing.lamps import Lamps
from khep_twin.world import World


@dataclass(frozen=True, slots=True)
class SampledChannel:
    """Channel of registers of the board or a turret: frame of its messages, and columns in a sample."""

    topic: str
    schema: str
    frame: ArrayFrame | ImageFrame
    columns: list[int] | slice

    def messages(self, times_ns: NDArray[np.int64], samples: NDArray[np.int64]) -> NDArray[np.void]:
        """Return one message for each sample (n,)."""
        values, frame = samples[:, self.columns], self.frame
        return frame.messages(times_ns, values) if isinstance(frame, ImageFrame) else frame.messages(values)


class SampleLayout:
    """Layout of the samples of one world, with the `channels` of all robots' registers."""

    def __init__(self, world: World) -> None:
        model, data = world.model, world.data
        registers = [board for robot in world.robots for board in board_registers(robot)]
        arrays = [data.qpos, data.qvel, *registers, data.xpos, data.xquat]
        *offsets, self._size = accumulate((array.size for array in arrays), initial=0)
        self._buffers = [array.data for array in arrays]
        starts = iter(offsets[2:-2])
        self.channels = [channel for robot in world.robots for channel in _make_channels(robot, starts)]
        # Moving bodies have poses in every sample; fixed ones are part of the description.
        self._n_bodies: int = model.nbody
        self._moving_bodies = MovingBodies(model)
        self._state_size, self._quaternion_start = offsets[-2:]

    def take_sample(self) -> bytes:
        """Return a sample of the present state."""
        return b"".join(self._buffers)

    def table(self, samples: Sequence[bytes]) -> NDArray[np.int64]:
        """Return samples as rows (n, columns); the bits of floats are read as integers."""
        return np.frombuffer(b"".join(samples), np.int64).reshape(-1, self._size)

    def states(self, table: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the states in samples (n, state)."""
        return table[:, : self._state_size]

    def transforms(self, times_ns: NDArray[np.int64], table: NDArray[np.int64]) -> NDArray[np.void]:
        """Return one message of /tf for each sample (n,)."""
        columns, start, shape = table.view(np.float64), self._quaternion_start, (len(table), self._n_bodies)
        positions = columns[:, self._state_size : start].reshape(*shape, 3)
        return self._moving_bodies.messages(times_ns, positions, columns[:, start:].reshape(*shape, 4))


def channel_names_message(channels: Iterable[SampledRegisters]) -> bytes:
    """Return a message that names the numbers of each channel, for viewers that only show indices."""
    channels_by_label: dict[str, dict[str, None]] = {}
    for channel in channels:
        channels_by_label.setdefault(channel.label, {})[channel.name] = None
    lines = ["Numbers of each robot's channels:"]
    for label, label_channels in channels_by_label.items():
        value_names, _, unit = label.removesuffix("]").partition(" [")
        lines += ["", f"{', '.join(label_channels)} [{unit}]"]
        lines += [f"  [{index}]  {name}" for index, name in enumerate(value_names.split(", "))]
    return text_message("\n".join(lines))


def _make_channels(robot: Robot, board_offsets: Iterator[int]) -> Iterator[SampledChannel]:
    """Yield the channels of a robot; `board_offsets` are the first columns of its board and each turret."""
    turrets = [None, *robot.firmware.turrets]
    # `zip` stops at the end of the turrets, so that `board_offsets` continues at the next robot.
    for turret, board, start in zip(turrets, board_registers(robot), board_offsets, strict=False):
        if turret is None:
            for name, label, registers in robot.sampled:
                frame = ArrayFrame(len(registers), "f8", label)
                columns = [start + register for register in registers]
                yield SampledChannel(f"/{robot.name}/{name}", FLOATS, frame, columns)
        name = "registers" if turret is None else turret.name
        label = ", ".join(turret.names) if turret and turret.names else "registers"
        board_columns = range(start, start + len(board))
        frame = ArrayFrame(len(board), "i8", label)
        yield SampledChannel(f"/{robot.name}/{name}", INTEGERS, frame, slice(start, board_columns.stop))
        if turret and turret.image:
            pixels = board_columns[turret.image]
            image = ImageFrame(len(pixels), f"{robot.name}/{turret.name}")
            yield SampledChannel(f"/{robot.name}/vision", IMAGE, image, slice(pixels.start, pixels.stop))


class LampsChannel:
    """Channel of the powers of a set of lamps; none for constant lamps that are not switched."""

    def __init__(self, lamps: Lamps) -> None:
        self.n_sets = 1
        self._lamps = lamps
        self._frame = None if lamps.are_constant else _make_frame(lamps)

    @property
    def topic(self) -> str:
        """Topic of the present set."""
        return "/lamps" if self.n_sets == 1 else f"/lamps_{self.n_sets}"

    @property
    def is_recorded(self) -> bool:
        """True if the powers of the present set are recorded."""
        return self._frame is not None

    def matches(self, lamps: Lamps) -> bool:
        """Return whether the channel is that of these lamps, in their present mode."""
        return lamps is self._lamps and (self.is_recorded or lamps.are_constant)

    def switch_to(self, lamps: Lamps) -> None:
        """Record the powers of these lamps from now on."""
        if lamps is not self._lamps:
            self.n_sets += 1
        self._lamps, self._frame = lamps, _make_frame(lamps)

    def move_to(self, lamps: Lamps) -> None:
        """Continue with the same lamps in another world, as objects of that world."""
        self._lamps = lamps
        if not (self.is_recorded or lamps.are_constant):
            self._frame = _make_frame(lamps)

    def resume(self, state: RecorderState) -> None:
        """Resume from the state of the recorder of a previous log."""
        self.n_sets = state.lamps_sets
        self._frame = _make_frame(self._lamps) if state.lamps_change else None

    def messages(self, powers: Sequence[Sequence[float]]) -> NDArray[np.void] | None:
        """Return one message for the powers of each sample (n, lamps) [W]; None if they are not recorded."""
        shape = len(powers), len(self._lamps.names)
        return None if self._frame is None else self._frame.messages(np.array(powers).reshape(shape))


def _make_frame(lamps: Lamps) -> ArrayFrame:
    return ArrayFrame(len(lamps.names), "f8", "power [W]")
