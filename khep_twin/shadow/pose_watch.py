"""Watch of the estimated pose: its state, by the width of its region and by replies that surprise.

    followed   the pose is known, and replies are as expected
    unsure     its region is wide, or replies surprise
    lost       it is searched for: the start is unknown, or replies tell that the robot is elsewhere

A pose that is lost is followed again once it is known for a while, without surprise that lasts.
"""

import math
from collections import deque
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from khep_twin.log.shadow_channels import PoseState
from khep_twin.shadow.thresholds import THRESHOLDS

Floats = NDArray[np.float64]


class Onset(NamedTuple):
    """Begin of replies that surprise.

    Attributes:
        calm_ns: Time of the last reply that confirmed the pose [ns].
        jumps_ns: Times of the replies before those with half of the largest surprise or more, the first one
            of each onset [ns].
        most_ns: Time of the reply before the one with the largest [ns].
    """

    calm_ns: int
    jumps_ns: tuple[int, ...]
    most_ns: int

    def later(self, other: "Onset") -> "Onset":
        """Return this begin, with the surprise of a later one that it does not explain."""
        return Onset(self.calm_ns, (self.jumps_ns[0], *other.jumps_ns), other.most_ns)


class _Heard(NamedTuple):
    """A reply: its time and that of the one before [ns], the largest sum by then, and its own surprise.

    It has something in sight, or not.
    """

    time_ns: int
    before_ns: int
    whole: float
    own: float
    in_sight: bool


class PoseWatch:
    """Watch of an estimated pose.

    Args:
        state: State at the start.

    Attributes:
        state: State of the pose.
        surprise: Surprise of each sensor, summed over the last replies (8,), in logarithms.
        vague_ns: Begin and end of the last time for which the pose was not known [ns]; long ago before any.
        surprised_ns: Time since when replies surprise [ns]; None while they do not.
    """

    def __init__(self, state: PoseState) -> None:
        self.state = state
        self.surprise: Floats = np.zeros(8)
        self.vague_ns = 0, -THRESHOLDS.window_ns
        self.surprised_ns: int | None = None
        self._seen_ns = self._unsettled_ns = self._turned_ns = 0
        self._is_settled: bool = state is PoseState.FOLLOWED
        self._found_ns: int | None = None
        self._startled = THRESHOLDS.startled
        self._heard: deque[_Heard] = deque()

    def see(self, time_ns: int, surprise: Floats, *, in_sight: bool, is_known: bool) -> None:
        """Take what a reply to N was less likely than an expected one (8,).

        Something is in sight, or not; the pose is known, or not.
        """
        before_ns, self._seen_ns = self._seen_ns, time_ns
        self.surprise = self.surprise * math.exp((before_ns - time_ns) * 1e-9 / THRESHOLDS.surprise_s)
        surprise = np.maximum(surprise - THRESHOLDS.usual, 0)
        self.surprise += surprise
        whole, own = float(self.surprise.max()), float(surprise.sum())
        kept = math.exp((before_ns - time_ns) * 1e-9 / THRESHOLDS.raised_s)
        self._startled = THRESHOLDS.startled + (self._startled - THRESHOLDS.startled) * kept
        self._heard.append(_Heard(time_ns, before_ns, whole, own, in_sight))
        while self._heard[0].time_ns < time_ns - THRESHOLDS.window_ns:
            self._heard.popleft()
        if not is_known:
            began_ns, last_ns = self.vague_ns
            self.vague_ns = (began_ns if last_ns >= before_ns else time_ns), time_ns
        if whole <= THRESHOLDS.surprised:
            self.surprised_ns = None
        elif self.surprised_ns is None:
            self.surprised_ns = time_ns
        is_settled = is_known and self.surprised_ns is None
        if is_settled != self._is_settled:
            self._is_settled, self._turned_ns = is_settled, time_ns
        surprised_ns = time_ns if self.surprised_ns is None else self.surprised_ns
        if not is_known or time_ns - surprised_ns >= THRESHOLDS.told_ns:
            self._unsettled_ns = time_ns
        if self.state is not PoseState.LOST:
            if time_ns - self._turned_ns >= THRESHOLDS.held_ns:
                self.state = PoseState.FOLLOWED if is_settled else PoseState.UNSURE
        elif time_ns - self._unsettled_ns > THRESHOLDS.found_ns:
            self.state, self._found_ns = PoseState.FOLLOWED, time_ns

    def is_blind(self, time_ns: int) -> bool:
        """Return whether the pose is followed though no reply to N has come for a while, at a time [ns]."""
        return self.state is PoseState.FOLLOWED and time_ns - self._seen_ns > THRESHOLDS.told_ns

    def doubt(self, time_ns: int) -> None:
        """Take that the pose is not known any more at a time [ns]."""
        self.state, self._is_settled, self._turned_ns = PoseState.UNSURE, False, time_ns
        self.vague_ns = time_ns, time_ns

    def lose(self) -> None:
        """Begin a search for the pose."""
        self.state, self._unsettled_ns = PoseState.LOST, self._seen_ns
        self.explain()

    def explain(self) -> None:
        """Forget what surprised, as it has an explanation."""
        self.surprise[:] = 0
        self.surprised_ns = None
        self._heard.clear()

    def expect(self) -> None:
        """Expect as much surprise, for which a search has found no reason, for a while."""
        self._startled = min(self._startled * THRESHOLDS.raised, THRESHOLDS.most_startled)

    @property
    def onset(self) -> Onset | None:
        """Begin of replies that have surprised for a while, up to now; None if they do not."""
        if not self._heard or self._heard[-1].whole < self._startled:
            return None
        calm = max(THRESHOLDS.calm, self._heard[-1].whole / 10)
        quiet = next((each for each in reversed(self._heard) if each.whole < calm), self._heard[0])
        heard = reversed([each for each in self._heard if each.time_ns <= quiet.time_ns])
        begun = next((each for each in heard if each.in_sight), self._heard[0])
        since = [each for each in self._heard if each.time_ns > quiet.time_ns] or [self._heard[-1]]
        largest = max(since, key=lambda each: each.own)
        jump_ns = next(each.before_ns for each in since if each.own >= largest.own / 2)
        replies = sum(each.time_ns > jump_ns for each in since)
        if since[-1].time_ns - jump_ns < THRESHOLDS.waited_ns or replies < THRESHOLDS.replies:
            return None
        return Onset(begun.time_ns, (jump_ns,), largest.before_ns)

    @property
    def is_proven(self) -> bool:
        """True unless the pose is lost, or was found or begun only lately."""
        found_ns = self._found_ns
        wanted_ns = THRESHOLDS.begun_ns if found_ns is None else THRESHOLDS.proven_ns
        is_new = self._seen_ns - (found_ns or 0) < wanted_ns
        return self.state is not PoseState.LOST and not is_new

    def was_vague(self, time_ns: int, lately_ns: int = 0) -> bool:
        """Return whether the pose was not known at a time [ns], or lately then, by the last such time."""
        return self.vague_ns[0] <= time_ns <= self.vague_ns[1] + lately_ns
