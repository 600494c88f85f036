"""Comparison of bytes read with writes reported, and split of the bytes among hosts."""

import pytest

from khep_twin.ports.host_writes import Change, ReadState, split_at_departure, split_by_host

MATCHED, UNREPORTED, UNREAD, SPLIT = (
    ReadState.MATCHED,
    ReadState.UNREPORTED,
    ReadState.UNREAD,
    ReadState.SPLIT,
)

STAYED = Change()


@pytest.mark.parametrize(
    ("state", "has_read", "writes", "is_full", "next_state"),
    [
        pytest.param(MATCHED, False, 0, False, MATCHED, id="nothing-happens"),
        pytest.param(MATCHED, True, 1, False, MATCHED, id="a-write-is-read-and-reported"),
        pytest.param(MATCHED, True, 0, False, UNREPORTED, id="bytes-come-before-their-report"),
        pytest.param(MATCHED, False, 1, False, UNREAD, id="a-report-comes-before-its-bytes"),
        pytest.param(MATCHED, True, 1, True, UNREAD, id="a-reported-write-finds-too-little-room"),
        pytest.param(MATCHED, True, 0, True, SPLIT, id="bytes-before-their-report-find-too-little-room"),
        pytest.param(MATCHED, False, 0, True, UNREAD, id="there-is-no-room-at-all"),
        pytest.param(UNREPORTED, False, 0, False, UNREPORTED, id="the-report-is-still-to-come"),
        pytest.param(
            UNREPORTED, False, 1, False, UNREAD, id="a-report-without-new-bytes-is-taken-for-a-new-write"
        ),
        pytest.param(UNREPORTED, True, 1, False, MATCHED, id="a-report-with-new-bytes-ends-all-doubt"),
        pytest.param(UNREPORTED, True, 0, False, UNREPORTED, id="more-bytes-before-any-report"),
        pytest.param(UNREPORTED, True, 0, True, SPLIT, id="more-bytes-than-room-before-any-report"),
        pytest.param(UNREAD, True, 0, False, MATCHED, id="the-rest-of-a-write-is-read"),
        pytest.param(UNREAD, True, 0, True, UNREAD, id="a-part-of-the-rest-is-read"),
        pytest.param(UNREAD, True, 1, False, MATCHED, id="the-rest-and-another-write-are-read"),
        pytest.param(UNREAD, False, 1, False, UNREAD, id="another-report-and-still-no-bytes"),
        pytest.param(SPLIT, True, 0, False, UNREPORTED, id="the-rest-is-read-and-not-reported"),
        pytest.param(SPLIT, True, 1, False, MATCHED, id="the-rest-is-read-and-reported"),
        pytest.param(SPLIT, True, 1, True, UNREAD, id="a-part-of-the-rest-is-read-and-reported"),
        pytest.param(SPLIT, True, 0, True, SPLIT, id="a-part-of-the-rest-is-read-and-not-reported"),
    ],
)
def test_each_read_and_report_leads_to_the_next_state(
    state: ReadState, has_read: bool, writes: int, is_full: bool, next_state: ReadState
) -> None:
    assert state.next_state(has_read, writes, is_full) is next_state


@pytest.mark.parametrize(("state", "unread"), [(MATCHED, 2), (UNREPORTED, 1), (UNREAD, 3), (SPLIT, 2)])
def test_of_two_reported_writes_those_read_early_are_done_and_earlier_ones_are_left(
    state: ReadState, unread: int
) -> None:
    assert state.count_unread(2) == unread


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
    assert split_by_host(data, n_before, n_writes) == (last, rest)


@pytest.mark.parametrize(
    ("state", "first", "is_whole", "rest", "change", "later", "divided"),
    [
        pytest.param(
            MATCHED, b"N\n", True, b"B\n", Change(True, 1, 1), STAYED, (b"N\n", b"B\n"), id="a-write-each"
        ),
        pytest.param(
            UNREPORTED,
            b"",
            False,
            b"B\n",
            Change(True, 1, 1),
            STAYED,
            (b"", b"B\n"),
            id="the-last-was-read-early",
        ),
        pytest.param(
            UNREAD, b"N\n", True, b"B\n", Change(True, 0, 1), STAYED, (b"N\n", b"B\n"), id="some-was-left"
        ),
        pytest.param(
            MATCHED,
            b"",
            False,
            b"B\n",
            Change(True),
            Change(False, 1),
            (b"", b"B\n"),
            id="reported-afterwards",
        ),
        pytest.param(
            MATCHED,
            b"N\n",
            True,
            b"B\nO\n",
            Change(True, 1, 1),
            Change(True, 0, 1),
            (b"N\nB\n", b"O\n"),
            id="two-hosts-left-one-after-the-other",
        ),
        pytest.param(
            MATCHED,
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
    state: ReadState,
    first: bytes,
    is_whole: bool,
    rest: bytes,
    change: Change,
    later: Change,
    divided: tuple[bytes, bytes],
) -> None:
    assert split_at_departure(state, first, is_whole, rest, change, later) == divided
