"""Layout of a sample, and the channels whose numbers lie in it.

A sample is a copy of all that a world changes, eight bytes a number, so that it costs next to nothing; what
follows from it is computed for many samples at once. Its columns:

    | qpos | qvel | robot 0: board, turrets | robot 1 ... | xpos | xquat |
    |<------------------- state ------------------------>|<-- bodies -->|

The state is what the hashes are of. Positions and rotations of the bodies follow from it. The powers of lamps
that change have a channel beside it.
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
    TransformFrame,
    text_message,
)
from khep_twin.log.description import body_name
from khep_twin.log.snapshots import RecorderState, boards
from khep_twin.robot import Robot, SampledRegisters
from khep_twin.sensing.lamps import Lamps
from khep_twin.world import World

_FINENESS = 2.0**30
"""Steps of positions in a log per metre, and of rotations per 1: about a nanometre each.

Finer digits are noise of contacts, which does not compress: a seventh of the file. The hashes of the state
include them."""


@dataclass(frozen=True, slots=True)
class SampledChannel:
    """Channel of registers, of the board or of a turret: frame of its messages, columns in a sample."""

    topic: str
    schema: str
    frame: ArrayFrame | ImageFrame
    columns: list[int] | slice

    def messages(self, times_ns: NDArray[np.int64], samples: NDArray[np.int64]) -> NDArray[np.void]:
        """Return a message for each sample (n,)."""
        found, frame = samples[:, self.columns], self.frame
        return frame.messages(times_ns, found) if isinstance(frame, ImageFrame) else frame.messages(found)


class SampleLayout:
    """Layout of the samples of one world.

    Attributes:
        channels: Channels of all robots' registers.
    """

    def __init__(self, world: World) -> None:
        model, data = world.model, world.data
        registers = [board for robot in world.robots for board in boards(robot)]
        sources = [data.qpos, data.qvel, *registers, data.xpos, data.xquat]
        *starts, self._size = accumulate((source.size for source in sources), initial=0)
        self._memories = [source.data for source in sources]
        columns = iter(starts[2:-2])
        self.channels = [channel for robot in world.robots for channel in _channels_of(robot, columns)]
        # Moving bodies are shown at every sample, fixed ones are part of the description.
        moving: NDArray[np.intp] = np.flatnonzero(model.body_weldid != 0)
        self._transforms = TransformFrame([body_name(model, body) for body in moving])
        self._state_size, turns = starts[-2:]
        places = np.add.outer(self._state_size + 3 * moving, [0, 1, 2])
        self._poses = np.hstack([places, np.add.outer(turns + 4 * moving, [1, 2, 3, 0])])

    def take(self) -> bytes:
        """Return a sample of the present."""
        return b"".join(self._memories)

    def table(self, samples: Sequence[bytes]) -> NDArray[np.int64]:
        """Return samples as a row each (n, columns); floats are seen as integers."""
        return np.frombuffer(b"".join(samples), np.int64).reshape(-1, self._size)

    def states(self, table: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the states in samples (n, state)."""
        return table[:, : self._state_size]

    def transforms(self, times_ns: NDArray[np.int64], table: NDArray[np.int64]) -> NDArray[np.void]:
        """Return a message of /tf for each sample (n,)."""
        poses = np.rint(table.view(np.float64)[:, self._poses] * _FINENESS) / _FINENESS
        return self._transforms.messages(times_ns, poses)


def channel_names(channels: Iterable[SampledRegisters]) -> bytes:
    """Return a message that names the numbers of each channel, for viewers that only index them."""
    topics: dict[str, dict[str, None]] = {}
    for channel in channels:
        topics.setdefault(channel.label, {})[channel.name] = None
    lines = ["Numbers of each robot's channels:"]
    for label, found in topics.items():
        names, _, unit = label.removesuffix("]").partition(" [")
        lines += ["", f"{', '.join(found)} [{unit}]"]
        lines += [f"  [{index}]  {name}" for index, name in enumerate(names.split(", "))]
    return text_message("\n".join(lines))


def _channels_of(robot: Robot, starts: Iterator[int]) -> Iterator[SampledChannel]:
    """Yield the channels of a robot, whose boards begin at these columns."""
    kinds = [None, *robot.firmware.turrets]
    # The kinds end first, so that the next robot has its own columns.
    for kind, board, start in zip(kinds, boards(robot), starts, strict=False):
        if kind is None:
            for name, label, registers in robot.sampled:
                frame = ArrayFrame(len(registers), "f8", label)
                columns = [start + each for each in registers]
                yield SampledChannel(f"/{robot.name}/{name}", FLOATS, frame, columns)
        name = "registers" if kind is None else kind.name
        label = ", ".join(kind.names) if kind and kind.names else "registers"
        own = range(start, start + len(board))
        frame = ArrayFrame(len(board), "i8", label)
        yield SampledChannel(f"/{robot.name}/{name}", INTEGERS, frame, slice(own.start, own.stop))
        if kind and kind.image:
            pixels = own[kind.image]
            image = ImageFrame(len(pixels), f"{robot.name}/{kind.name}")
            yield SampledChannel(f"/{robot.name}/vision", IMAGE, image, slice(pixels.start, pixels.stop))


class LampsChannel:
    """Channel of one set of lamps at a time; steady lamps need none until one is switched by hand.

    Rows of a channel have one length, so lamps set up later have their own channel.
    """

    def __init__(self, lamps: Lamps) -> None:
        self.n_sets = 1
        self._lamps = lamps
        self._frame = None if lamps.steady else _frame(lamps)

    @property
    def topic(self) -> str:
        """Topic of the present set."""
        return "/lamps" if self.n_sets == 1 else f"/lamps_{self.n_sets}"

    @property
    def change(self) -> bool:
        """True if the powers of the present set are recorded."""
        return self._frame is not None

    def is_of(self, lamps: Lamps) -> bool:
        """Return whether it has the powers of these lamps as they are now."""
        return lamps is self._lamps and (self.change or lamps.steady)

    def follow(self, lamps: Lamps) -> None:
        """Go on with the powers of these lamps."""
        if lamps is not self._lamps:
            self.n_sets += 1
        self._lamps, self._frame = lamps, _frame(lamps)

    def move_to(self, lamps: Lamps) -> None:
        """Go on with the same lamps in another world."""
        self._lamps = lamps
        if not (self.change or lamps.steady):
            self._frame = _frame(lamps)

    def resume(self, state: RecorderState) -> None:
        """Go on from another recorder's state."""
        self.n_sets = state.lamps_sets
        self._frame = _frame(self._lamps) if state.lamps_change else None

    def messages(self, powers: Sequence[Sequence[float]]) -> NDArray[np.void] | None:
        """Return a message for the powers of each sample (n, lamps) [W]; None if they are not recorded."""
        shape = len(powers), len(self._lamps.names)
        return None if self._frame is None else self._frame.messages(np.array(powers).reshape(shape))


def _frame(lamps: Lamps) -> ArrayFrame:
    return ArrayFrame(len(lamps.names), "f8", "power [W]")
