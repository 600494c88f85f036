"""Watch of the estimated pose: its state, by the width of its region and by replies that surprise.

    followed   the pose is known, and replies are as expected
    unsure     its region is wide, or replies surprise
    lost       it is searched for: the start is unknown, or replies tell that the robot is elsewhere

A pose that is lost is followed again once it is known for a while, without surprise that lasts.
"""

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from khep_twin.log.shadow_channels import PoseState
from khep_twin.shadow.thresholds import THRESHOLDS

Floats = NDArray[np.float64]

_ONSETS = 20
"""Beginnings of surprise that are kept."""


class PoseWatch:
    """Watch of an estimated pose.

    Args:
        state: State at the start.

    Attributes:
        state: State of the pose.
        surprise: Surprise of each sensor, summed over the last replies (8,), in logarithms.
        vague_ns: Begin and end of the last time for which the pose was not known [ns]; -1 before any.
        surprised_ns: Time since when replies surprise [ns]; None while they do not.
    """

    def __init__(self, state: PoseState) -> None:
        self.state = state
        self.surprise: Floats = np.zeros(8)
        self.vague_ns = -1, -1
        self.surprised_ns: int | None = None
        self._seen_ns = self._unsettled_ns = self._turned_ns = 0
        self._is_settled: bool = state is PoseState.FOLLOWED
        self._startled_ns: int | None = None
        self._found_ns: int | None = None
        self._onsets: deque[int] = deque(maxlen=_ONSETS)

    def see(self, time_ns: int, surprise: Floats, *, is_known: bool) -> None:
        """Take what a reply to N was less likely than an expected one (8,), and whether the pose is known."""
        before_ns, self._seen_ns = self._seen_ns, time_ns
        self.surprise = self.surprise * math.exp((before_ns - time_ns) * 1e-9 / THRESHOLDS.surprise_s)
        self.surprise += np.maximum(surprise - THRESHOLDS.usual, 0)
        if not is_known:
            began_ns, last_ns = self.vague_ns
            self.vague_ns = (began_ns if last_ns == before_ns else time_ns), time_ns
        if self.surprise.max() > THRESHOLDS.startled:
            self._startled_ns = time_ns
        if self.surprise.max() <= THRESHOLDS.surprised:
            self.surprised_ns = None
        elif self.surprised_ns is None:
            self.surprised_ns = time_ns
            self._onsets.append(before_ns)
        is_settled = is_known and self.surprised_ns is None
        if is_settled != self._is_settled:
            self._is_settled, self._turned_ns = is_settled, time_ns
        surprised_ns = time_ns if self.surprised_ns is None else self.surprised_ns
        if not is_known or time_ns - surprised_ns >= THRESHOLDS.waited_ns:
            self._unsettled_ns = time_ns
        if self.state is not PoseState.LOST:
            if time_ns - self._turned_ns >= THRESHOLDS.held_ns:
                self.state = PoseState.FOLLOWED if is_settled else PoseState.UNSURE
        elif time_ns - self._unsettled_ns > THRESHOLDS.found_ns:
            self.state, self._found_ns = PoseState.FOLLOWED, time_ns

    def lose(self) -> None:
        """Begin a search for the pose."""
        self.state = PoseState.LOST
        self.surprise[:] = 0

    @property
    def is_proven(self) -> bool:
        """True unless the pose is lost, or was found only lately."""
        found_ns = self._found_ns
        is_new = found_ns is not None and self._seen_ns - found_ns < THRESHOLDS.proven_ns
        return self.state is not PoseState.LOST and not is_new

    def was_startled(self, since_ns: int) -> bool:
        """Return whether a reply surprised at all after what seems to have begun at a time [ns]."""
        return self._startled_ns is not None and self._startled_ns > since_ns - THRESHOLDS.earlier_ns

    def was_vague(self, time_ns: int) -> bool:
        """Return whether the pose was not known at a time [ns], or just before, of the last such time."""
        return self.vague_ns[0] <= time_ns <= self.vague_ns[1] + THRESHOLDS.told_ns

    def onset_ns(self, since_ns: int) -> int:
        """Return the time of the reply before those that surprised since about a time [ns]."""
        return next((each for each in self._onsets if each > since_ns - THRESHOLDS.earlier_ns), since_ns)

    @property
    def last_onset_ns(self) -> int:
        """Time of the reply before those that surprise now [ns]."""
        return self._onsets[-1]
