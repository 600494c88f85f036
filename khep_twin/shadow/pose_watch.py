"""Watch of the estimated pose: its state, by the width of its region and by unexpected replies.

    followed -- wide region or high surprisal, for 0.4 s; no reply to N for 1 s --> unsure
    unsure   -- known pose, low surprisal, for 0.4 s --> followed
    any      -- the robot was put elsewhere --> lost
    lost     -- known pose, without lasting surprisal, for 5 s --> followed

A pose that is unknown at the start is lost. The surprisal of a reply is the logarithm by which its likelihood
is below that of the most probable reply; for Gaussian noise, half the squared normalised innovation.
"""

import math
from collections import deque
from typing import NamedTuple

import numpy as np

from khep_twin.log.shadow_channels import PoseState
from khep_twin.shadow.pose_estimate import Floats
from khep_twin.shadow.thresholds import THRESHOLDS


class Onset(NamedTuple):
    """Onset of unexpected replies.

    Attributes:
        calm_ns: Time of the last reply that confirmed the pose [ns].
        jumps_ns: Of each onset, time before the first reply with half of the largest surprisal or more [ns].
        largest_ns: Time of the reply before the one with the largest surprisal [ns].
    """

    calm_ns: int
    jumps_ns: tuple[int, ...]
    largest_ns: int

    def merge(self, later: "Onset") -> "Onset":
        """Return this onset with the jumps of a later one, which it does not explain."""
        return Onset(self.calm_ns, (self.jumps_ns[0], *later.jumps_ns), later.largest_ns)


class _Reply(NamedTuple):
    """A reply to N: its time and that of the previous reply [ns], and whether an obstacle is in sight.

    `largest_sum` is the largest summed surprisal of a sensor so far, `surprisal` that of this reply alone.
    """

    time_ns: int
    previous_ns: int
    largest_sum: float
    surprisal: float
    in_sight: bool


class PoseWatch:
    """Watch of an estimated pose.

    Args:
        state: State at the start.

    Attributes:
        state: State of the pose.
        surprisal: Surprisal of each sensor, summed over the last replies with exponential decay (n,).
        unknown_ns: Start and end of the last time for which the pose was unknown [ns]; long ago before any.
        unexpected_since_ns: Time since when replies are unexpected [ns]; None while they are not.
    """

    def __init__(self, state: PoseState) -> None:
        self.state = state
        self.surprisal: Floats = np.zeros(1)
        self.unknown_ns = 0, -THRESHOLDS.window_ns
        self.unexpected_since_ns: int | None = None
        self._last_reply_ns = 0
        self._last_unsettled_ns = 0
        self._is_settled: bool = state is PoseState.FOLLOWED
        self._settled_since_ns = 0
        """Time since when `_is_settled` has its value [ns]."""
        self._relocated_ns: int | None = None
        self._search_above = THRESHOLDS.search_above
        self._replies: deque[_Reply] = deque()

    def update(self, time_ns: int, surprisal: Floats, *, in_sight: bool, is_known: bool) -> None:
        """Update by a reply's surprisal, by sensor (n,); `in_sight` is an obstacle, `is_known` the pose."""
        previous_ns, self._last_reply_ns = self._last_reply_ns, time_ns
        self.surprisal = self.surprisal * math.exp((previous_ns - time_ns) * 1e-9 / THRESHOLDS.surprisal_s)
        surprisal = np.maximum(surprisal - THRESHOLDS.usual_surprisal, 0)
        self.surprisal = self.surprisal + surprisal
        largest_sum = float(self.surprisal.max())
        decay = math.exp((previous_ns - time_ns) * 1e-9 / THRESHOLDS.raise_decay_s)
        self._search_above = THRESHOLDS.search_above + (self._search_above - THRESHOLDS.search_above) * decay
        self._replies.append(_Reply(time_ns, previous_ns, largest_sum, float(surprisal.sum()), in_sight))
        while self._replies[0].time_ns < time_ns - THRESHOLDS.window_ns:
            self._replies.popleft()
        if not is_known:
            start_ns, end_ns = self.unknown_ns
            self.unknown_ns = (start_ns if end_ns >= previous_ns else time_ns), time_ns
        if largest_sum <= THRESHOLDS.unsure_above:
            self.unexpected_since_ns = None
        elif self.unexpected_since_ns is None:
            self.unexpected_since_ns = time_ns
        is_settled = is_known and self.unexpected_since_ns is None
        if is_settled != self._is_settled:
            self._is_settled = is_settled
            self._settled_since_ns = time_ns
        unexpected_ns = time_ns if self.unexpected_since_ns is None else self.unexpected_since_ns
        if not is_known or time_ns - unexpected_ns >= THRESHOLDS.alarm_delay_ns:
            self._last_unsettled_ns = time_ns
        if self.state is not PoseState.LOST:
            if time_ns - self._settled_since_ns >= THRESHOLDS.hold_ns:
                self.state = PoseState.FOLLOWED if is_settled else PoseState.UNSURE
        elif time_ns - self._last_unsettled_ns > THRESHOLDS.relocated_ns:
            self.state = PoseState.FOLLOWED
            self._relocated_ns = time_ns

    def is_blind(self, time_ns: int) -> bool:
        """Return whether the pose is followed though no reply to N has come for a while, at a time [ns]."""
        silence_ns = time_ns - self._last_reply_ns
        return self.state is PoseState.FOLLOWED and silence_ns > THRESHOLDS.alarm_delay_ns

    def set_unsure(self, time_ns: int) -> None:
        """Set the state of a pose that is unknown from a time on [ns]."""
        self.state = PoseState.UNSURE
        self._is_settled = False
        self._settled_since_ns = time_ns
        self.unknown_ns = time_ns, time_ns

    def lose(self) -> None:
        """Set the state of a robot that was put elsewhere."""
        self.state = PoseState.LOST
        self._last_unsettled_ns = self._last_reply_ns
        self.reset_surprisal()

    def reset_surprisal(self) -> None:
        """Drop the surprisal so far, which is explained."""
        self.surprisal[:] = 0
        self.unexpected_since_ns = None
        self._replies.clear()

    def raise_threshold(self) -> None:
        """Raise the threshold of a search for a while, as the last one has found nothing."""
        self._search_above = min(self._search_above * THRESHOLDS.raise_factor, THRESHOLDS.max_search_above)

    @property
    def onset(self) -> Onset | None:
        """Onset of replies that have been unexpected for a while, up to now; None if they are not."""
        if not self._replies or self._replies[-1].largest_sum < self._search_above:
            return None
        limit = max(THRESHOLDS.calm_below, self._replies[-1].largest_sum / 10)
        calm = (reply.time_ns for reply in reversed(self._replies) if reply.largest_sum < limit)
        calm_ns = next(calm, self._replies[0].time_ns)
        sights = (reply for reply in reversed(self._replies) if reply.time_ns <= calm_ns and reply.in_sight)
        confirmation = next(sights, self._replies[0])
        replies = [reply for reply in self._replies if reply.time_ns > calm_ns] or [self._replies[-1]]
        largest = max(replies, key=lambda reply: reply.surprisal)
        jump_ns = next(reply.previous_ns for reply in replies if reply.surprisal >= largest.surprisal / 2)
        n_replies = sum(reply.time_ns > jump_ns for reply in replies)
        if replies[-1].time_ns - jump_ns < THRESHOLDS.search_delay_ns or n_replies < THRESHOLDS.min_replies:
            return None
        return Onset(confirmation.time_ns, (jump_ns,), largest.previous_ns)

    @property
    def is_proven(self) -> bool:
        """True unless the pose is lost, or is known since recently only."""
        relocated_ns = self._relocated_ns
        proven_ns = THRESHOLDS.start_proven_ns if relocated_ns is None else THRESHOLDS.proven_ns
        is_recent = self._last_reply_ns - (relocated_ns or 0) < proven_ns
        return self.state is not PoseState.LOST and not is_recent

    def was_unknown(self, time_ns: int, margin_ns: int = 0) -> bool:
        """Return whether the pose was unknown at a time [ns], or up to a margin before, by the last time."""
        return self.unknown_ns[0] <= time_ns <= self.unknown_ns[1] + margin_ns
