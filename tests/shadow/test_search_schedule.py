"""Schedule of the searches for changes."""

from twins import SECOND

from khep_twin.shadow.pose_watch import Onset
from khep_twin.shadow.search_schedule import SearchSchedule, SearchState

ONSET = Onset(1 * SECOND, (2 * SECOND,), 2 * SECOND)
LATER = Onset(3 * SECOND, (4 * SECOND,), 4 * SECOND)


def test_a_search_is_due_at_intervals_that_grow_with_the_time_since_the_onset() -> None:
    schedule = SearchSchedule()
    assert schedule.pending_onset(3 * SECOND, None, is_explained=False) is None
    assert schedule.pending_onset(3 * SECOND, ONSET, is_explained=False) == ONSET
    assert schedule.is_due(3 * SECOND, ONSET, was_known=True)
    assert not schedule.is_due(3 * SECOND, ONSET, was_known=False)
    schedule.start(3 * SECOND, ONSET)
    assert not schedule.is_due(round(3.3 * SECOND), ONSET, was_known=True)
    assert schedule.is_due(4 * SECOND, ONSET, was_known=True)


def test_a_later_onset_is_merged_with_the_last_one_while_that_is_recent_or_explains_the_replies() -> None:
    schedule = SearchSchedule()
    schedule.start(3 * SECOND, ONSET)
    assert schedule.pending_onset(5 * SECOND, LATER, is_explained=False) == ONSET.merge(LATER)
    assert schedule.pending_onset(9 * SECOND, LATER, is_explained=True) == ONSET.merge(LATER)
    assert schedule.pending_onset(9 * SECOND, LATER, is_explained=False) == LATER


def test_a_search_is_repeated_once_at_an_unknown_pose_and_without_a_new_onset() -> None:
    schedule = SearchSchedule()
    schedule.start(3 * SECOND, ONSET)
    schedule.state = SearchState.REPEAT
    onset = schedule.pending_onset(5 * SECOND, None, is_explained=False)
    assert onset == ONSET.merge(ONSET)
    assert schedule.is_due(5 * SECOND, ONSET, was_known=False)
    schedule.start(5 * SECOND, ONSET)
    assert schedule.state is SearchState.NOT_FOUND
    assert schedule.pending_onset(6 * SECOND, None, is_explained=False) is None
