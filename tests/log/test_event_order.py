"""Host events of several robots are repeated in the order of their times, for any flushes."""

from pathlib import Path

from khep_twin.board.uart import HostEvent, HostEventKind
from khep_twin.log.entries import Entry
from khep_twin.log.host_events import events_message
from khep_twin.log.recorded import order_events

ROBOTS = "khepera0", "khepera1", "khepera2"
SEND, NOTE = HostEventKind.SEND, HostEventKind.NOTE


def entry(robot: int, *events: tuple[int, HostEventKind]) -> Entry:
    """Return a message of a robot's events, with times [ns] and kinds."""
    host_events = [(time_ns, HostEvent(kind, time_ns, None, b"N\n")) for time_ns, kind in events]
    return Entry(f"/{ROBOTS[robot]}/host_events", "", None, events[0][0], events_message(host_events))


def test_events_after_a_note_of_one_robot_stay_in_the_order_of_their_times() -> None:
    chunks = [
        [entry(0, (1, SEND), (5, SEND), (5, NOTE))],
        [entry(1, (5, SEND)), entry(2, (5, SEND))],
        [entry(0, (7, SEND), (9, SEND)), entry(1, (7, SEND), (9, SEND)), entry(2, (6, SEND), (9, SEND))],
    ]
    events = [(time_ns, robot) for time_ns, robot, _ in order_events(Path("x.mcap"), chunks, ROBOTS)]
    expected = [(1, 0), (5, 0), (5, 0), (5, 1), (5, 2), (6, 2), (7, 0), (7, 1), (9, 0), (9, 1), (9, 2)]
    assert events == expected
