"""Schedule of the search for changes, by the outcome of the last one.

    not found -- a search finds a change --> found -- a search finds none --> not found
    not found -- a change becomes certain without a search --> repeat -- any search --> found or not found

In `REPEAT` a change became certain after a search that found none. The robot may also be elsewhere, where
only a search has particles.
"""

from enum import Enum, auto

from khep_twin.shadow.pose_watch import Onset
from khep_twin.shadow.thresholds import THRESHOLDS


class SearchState(Enum):
    """Outcome of the last search: no change, a change, or none while another search is due."""

    NOT_FOUND = auto()
    CHANGE_FOUND = auto()
    REPEAT = auto()


class SearchSchedule:
    """Schedule of searches.

    Attributes:
        state: Outcome of the last search.
        last_ns: Time of the last search [ns]; 0 before any.
    """

    def __init__(self) -> None:
        self.state = SearchState.NOT_FOUND
        self.last_ns = 0
        self._onset: Onset | None = None

    def pending_onset(self, time_ns: int, onset: Onset | None, is_explained: bool) -> Onset | None:
        """Return the onset from which to search, given the present one; None if replies are as expected.

        `is_explained` is True if the changes that are considered explain the replies.
        """
        last = self._onset
        if onset is None and self.state is SearchState.REPEAT:
            onset = last
        if onset is None or last is None:
            return onset
        # The last search has found too little, or nothing.
        is_continued = is_explained or time_ns - last.calm_ns < THRESHOLDS.window_ns
        return last.merge(onset) if is_continued else onset

    def is_due(self, time_ns: int, onset: Onset, was_known: bool) -> bool:
        """Return whether to search now; `was_known` if the pose was known at the onset.

        The interval of searches is half the time since the onset, within limits.
        """
        interval_ns = min((time_ns - onset.jumps_ns[0]) // 2, THRESHOLDS.max_search_interval_ns)
        can_search = was_known or self.state is SearchState.REPEAT
        return can_search and time_ns - self.last_ns >= max(interval_ns, THRESHOLDS.search_delay_ns)

    def start(self, time_ns: int, onset: Onset) -> None:
        """Note that a search starts."""
        self.last_ns = time_ns
        self._onset = onset
        if self.state is SearchState.REPEAT:
            self.state = SearchState.NOT_FOUND
