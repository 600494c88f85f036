"""Bytes that were read are compared with writes that were reported, and divided among hosts."""

import pytest

from khep_twin.ports.host_writes import Change, Reading, divide, divide_at_leaving

EVEN, AHEAD, BEHIND, SPLIT = Reading.EVEN, Reading.AHEAD, Reading.BEHIND, Reading.SPLIT

STAYED = Change()


@pytest.mark.parametrize(
    ("state", "got_bytes", "writes", "more", "next_state"),
    [
        pytest.param(EVEN, False, 0, False, EVEN, id="nothing-happens"),
        pytest.param(EVEN, True, 1, False, EVEN, id="a-write-is-read-and-reported"),
        pytest.param(EVEN, True, 0, False, AHEAD, id="bytes-come-before-their-report"),
        pytest.param(EVEN, False, 1, False, BEHIND, id="a-report-comes-before-its-bytes"),
        pytest.param(EVEN, True, 1, True, BEHIND, id="a-reported-write-finds-too-little-room"),
        pytest.param(EVEN, True, 0, True, SPLIT, id="bytes-before-their-report-find-too-little-room"),
        pytest.param(EVEN, False, 0, True, BEHIND, id="there-is-no-room-at-all"),
        pytest.param(AHEAD, False, 0, False, AHEAD, id="the-report-is-still-to-come"),
        pytest.param(
            AHEAD, False, 1, False, BEHIND, id="a-report-without-new-bytes-is-taken-for-a-new-write"
        ),
        pytest.param(AHEAD, True, 1, False, EVEN, id="a-report-with-new-bytes-ends-all-doubt"),
        pytest.param(AHEAD, True, 0, False, AHEAD, id="more-bytes-before-any-report"),
        pytest.param(AHEAD, True, 0, True, SPLIT, id="more-bytes-than-room-before-any-report"),
        pytest.param(BEHIND, True, 0, False, EVEN, id="the-rest-of-a-write-is-read"),
        pytest.param(BEHIND, True, 0, True, BEHIND, id="a-part-of-the-rest-is-read"),
        pytest.param(BEHIND, True, 1, False, EVEN, id="the-rest-and-another-write-are-read"),
        pytest.param(BEHIND, False, 1, False, BEHIND, id="another-report-and-still-no-bytes"),
        pytest.param(SPLIT, True, 0, False, AHEAD, id="the-rest-is-read-and-not-reported"),
        pytest.param(SPLIT, True, 1, False, EVEN, id="the-rest-is-read-and-reported"),
        pytest.param(SPLIT, True, 1, True, BEHIND, id="a-part-of-the-rest-is-read-and-reported"),
        pytest.param(SPLIT, True, 0, True, SPLIT, id="a-part-of-the-rest-is-read-and-not-reported"),
    ],
)
def test_each_read_and_report_leads_to_the_next_state(
    state: Reading, got_bytes: bool, writes: int, more: bool, next_state: Reading
) -> None:
    assert state.after(got_bytes, writes, more) is next_state


@pytest.mark.parametrize(("state", "unread"), [(EVEN, 2), (AHEAD, 1), (BEHIND, 3), (SPLIT, 2)])
def test_of_two_reported_writes_those_read_early_are_done_and_earlier_ones_are_left(
    state: Reading, unread: int
) -> None:
    assert state.unread(2) == unread


@pytest.mark.parametrize(
    ("data", "n_before", "n_writes", "last", "rest"),
    [
        pytest.param(b"N\n", 0, 1, b"", b"N\n", id="only-the-next-host-has-written"),
        pytest.param(b"N\n", 1, 0, b"N\n", b"", id="only-the-last-host-has-written"),
        pytest.param(b"N\nB\n", 1, 1, b"N\n", b"B\n", id="a-line-each"),
        pytest.param(b"N\nH\nB\n", 2, 1, b"N\nH\n", b"B\n", id="two-lines-and-one"),
        pytest.param(b"D,5N\n", 1, 1, b"D,5", b"N\n", id="an-unfinished-line-before-a-command"),
        pytest.param(b"\x00\xff\n", 1, 1, b"", b"\x00\xff\n", id="no-text"),
    ],
)
def test_bytes_are_divided_by_lines(
    data: bytes, n_before: int, n_writes: int, last: bytes, rest: bytes
) -> None:
    assert divide(data, n_before, n_writes) == (last, rest)


@pytest.mark.parametrize(
    ("state", "first", "is_whole", "rest", "change", "later", "divided"),
    [
        pytest.param(
            EVEN, b"N\n", True, b"B\n", Change(True, 1, 1), STAYED, (b"N\n", b"B\n"), id="a-write-each"
        ),
        pytest.param(
            AHEAD, b"", False, b"B\n", Change(True, 1, 1), STAYED, (b"", b"B\n"), id="the-last-was-read-early"
        ),
        pytest.param(
            BEHIND, b"N\n", True, b"B\n", Change(True, 0, 1), STAYED, (b"N\n", b"B\n"), id="some-was-left"
        ),
        pytest.param(
            EVEN, b"", False, b"B\n", Change(True), Change(False, 1), (b"", b"B\n"), id="reported-afterwards"
        ),
        pytest.param(
            EVEN,
            b"N\n",
            True,
            b"B\nO\n",
            Change(True, 1, 1),
            Change(True, 0, 1),
            (b"N\nB\n", b"O\n"),
            id="two-hosts-left-one-after-the-other",
        ),
        pytest.param(
            EVEN,
            b"N\n",
            True,
            b"B\nO\n",
            Change(True, 1, 0),
            Change(True, 0, 2),
            (b"N\n", b"B\nO\n"),
            id="who-wrote-first-left-and-all-else-is-the-next-one-s",
        ),
    ],
)
def test_bytes_around_a_leaving_are_of_the_right_hosts(
    state: Reading,
    first: bytes,
    is_whole: bool,
    rest: bytes,
    change: Change,
    later: Change,
    divided: tuple[bytes, bytes],
) -> None:
    assert divide_at_leaving(state, first, is_whole, rest, change, later) == divided
