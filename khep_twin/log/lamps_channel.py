"""Channel of the powers of a world's lamps, where they change."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from khep_twin.log.channels import ArrayFrame
from khep_twin.log.snapshots import RecorderState
from khep_twin.sensing.lamps import Lamps


class LampsChannel:
    """Channel of one set of lamps at a time; steady lamps need none until one is switched by hand.

    Rows of a channel have one length, so lamps set up later have their own channel.

    Attributes:
        n_sets: Number of sets of lamps so far.
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
