"""Channel of the lamps' powers across worlds: the same topic, and the lamps that are there."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from khep_twin.log.sample_layout import LampsChannel
from khep_twin.log.snapshots import RecorderState
from khep_twin.playpen import Lamp, Playpen
from khep_twin.sensing.lamps import Lamps

POWERS = st.lists(st.floats(0, 100), min_size=3, max_size=3)


def lamps(*, blink: bool, count: int = 3) -> Lamps:
    """Return lamps that are constant, or of which the last one blinks."""
    scene = Playpen.load("default")
    entries = [Lamp(x_mm=100 * number, y_mm=100, power_w=5) for number in range(1, count + 1)]
    if blink:
        entries[-1] = entries[-1].model_copy(update={"blink_period_s": 0.5})
    return Lamps(scene.model_copy(update={"lamps": tuple(entries)}), lambda: np.random.default_rng(1))


@pytest.mark.parametrize("before", [False, True])
@pytest.mark.parametrize("after", [False, True])
def test_lamps_of_another_world_are_recorded_from_the_first_that_changes(before: bool, after: bool) -> None:
    channel, moved = LampsChannel(lamps(blink=before)), lamps(blink=after)
    channel.move_to(moved)
    assert channel.is_recorded == (before or after)
    assert channel.matches(moved)
    assert channel.topic == "/lamps"
    assert not channel.matches(lamps(blink=after))


@given(POWERS, st.booleans(), st.booleans())
def test_powers_after_a_move_are_those_of_the_lamps_there(
    powers: list[float], before: bool, after: bool
) -> None:
    channel = LampsChannel(lamps(blink=before))
    channel.move_to(lamps(blink=after))
    messages = channel.messages([powers, powers])
    if not (before or after):
        assert messages is None
    else:
        assert messages is not None
        assert len(messages) == 2
        assert np.array(powers).tobytes() in messages.tobytes()


@pytest.mark.parametrize("count", [2, 4])
def test_a_switch_to_other_lamps_starts_a_topic_and_one_within_a_set_does_not(count: int) -> None:
    first, other = lamps(blink=False), lamps(blink=False, count=count)
    channel = LampsChannel(first)
    assert channel.matches(first)
    channel.switch_to(first)
    assert (channel.topic, channel.is_recorded) == ("/lamps", True)
    assert not channel.matches(other)
    channel.switch_to(other)
    assert (channel.topic, channel.is_recorded) == ("/lamps_2", True)
    assert channel.messages([range(count)]) is not None
    channel.move_to(lamps(blink=True, count=count))
    assert channel.topic == "/lamps_2"


@pytest.mark.parametrize("is_recorded", [False, True])
@pytest.mark.parametrize("blink", [False, True])
def test_a_resumed_log_records_the_lamps_as_its_parent_did(is_recorded: bool, blink: bool) -> None:
    channel = LampsChannel(lamps(blink=blink))
    channel.resume(RecorderState((), (), 3, is_recorded, ()))
    assert (channel.topic, channel.is_recorded) == ("/lamps_3", is_recorded)
