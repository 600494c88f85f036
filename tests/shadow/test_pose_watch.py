"""State of the estimated pose."""

import numpy as np
from twins import SECOND

from khep_twin.log.shadow_channels import PoseState
from khep_twin.shadow.pose_watch import Onset, PoseWatch

NOTHING, LARGE = np.zeros(8), np.full(8, 2.0)
TENTH = SECOND // 10


def feed(
    watch: PoseWatch, begin: int, end: int, *, is_known: bool = True, surprise: bool = False
) -> list[PoseState]:
    """States after replies at tenths of a second."""
    states: list[PoseState] = []
    for number in range(begin, end):
        watch.update(
            number * TENTH, LARGE if surprise else NOTHING, in_sight=number % 10 == 5, is_known=is_known
        )
        states.append(watch.state)
    return states


def test_a_pose_that_is_not_known_any_more_is_unsure_without_a_reply_to_n_as_well() -> None:
    watch = PoseWatch(PoseState.FOLLOWED)
    feed(watch, 1, 10)
    assert not watch.is_blind(15 * TENTH)
    assert watch.is_blind(30 * TENTH)
    watch.set_unsure(30 * TENTH)
    assert watch.state is PoseState.UNSURE
    feed(watch, 34, 35, is_known=False)
    assert watch.was_unknown(32 * TENTH)
    assert feed(watch, 35, 45)[-1] is PoseState.FOLLOWED


def test_it_is_unsure_while_the_region_is_wide_or_replies_surprise() -> None:
    watch = PoseWatch(PoseState.FOLLOWED)
    assert set(feed(watch, 1, 10)) == {PoseState.FOLLOWED}
    assert feed(watch, 10, 12, is_known=False)[-1] is PoseState.FOLLOWED  # not for long enough
    assert feed(watch, 12, 20, is_known=False)[-1] is PoseState.UNSURE
    assert watch.was_unknown(15 * TENTH)
    assert not watch.was_unknown(5 * TENTH)
    assert not watch.was_unknown(30 * TENTH)
    assert watch.was_unknown(30 * TENTH, 2 * 10 * TENTH)
    assert feed(watch, 20, 30)[-1] is PoseState.FOLLOWED
    assert feed(watch, 30, 40, surprise=True)[-1] is PoseState.UNSURE
    assert watch.unexpected_since_ns == 31 * TENTH
    assert watch.onset is not None
    assert feed(watch, 40, 70)[-1] is PoseState.FOLLOWED
    assert watch.onset is None


def test_what_surprises_most_may_have_begun_later_than_the_surprise() -> None:
    watch = PoseWatch(PoseState.FOLLOWED)
    feed(watch, 1, 10)
    for number in range(10, 14):
        watch.update(number * TENTH, LARGE * (1.8 if number == 13 else 1), in_sight=False, is_known=True)
    feed(watch, 14, 17)
    assert watch.onset == (5 * TENTH, (9 * TENTH,), 12 * TENTH)


def test_surprise_begins_after_the_last_reply_that_confirmed_the_pose() -> None:
    watch = PoseWatch(PoseState.FOLLOWED)
    feed(watch, 1, 30)
    assert watch.onset is None
    feed(watch, 30, 31, surprise=True)
    assert watch.onset is None  # not for long enough
    feed(watch, 31, 35, surprise=True)
    assert watch.onset == (25 * TENTH, (29 * TENTH,), 29 * TENTH)
    watch.reset_surprisal()
    assert watch.onset is None
    assert watch.state is PoseState.FOLLOWED
    feed(watch, 35, 40, surprise=True)
    later = watch.onset
    assert later is not None
    merged = Onset(25 * TENTH, (29 * TENTH,), 29 * TENTH).merge(later)
    assert merged == (25 * TENTH, (29 * TENTH, 35 * TENTH), later.largest_ns)
    for _ in range(9):
        watch.raise_threshold()  # Searches have found nothing.
    assert watch.onset is None
    assert feed(watch, 40, 1000)
    feed(watch, 1000, 1005, surprise=True)
    assert watch.onset is not None


def test_a_lost_pose_is_followed_once_it_is_known_for_a_while() -> None:
    watch = PoseWatch(PoseState.LOST)
    assert set(feed(watch, 1, 30, is_known=False)) == {PoseState.LOST}
    assert set(feed(watch, 30, 60)) == {PoseState.LOST}
    assert set(feed(watch, 60, 90, surprise=True)) == {PoseState.LOST}  # which lasts
    assert feed(watch, 90, 160)[-1] is PoseState.FOLLOWED
    watch.lose()
    assert set(feed(watch, 160, 200)) == {PoseState.LOST}  # though nothing surprises there
    assert feed(watch, 200, 220)[-1] is PoseState.FOLLOWED
