"""Alarms of a shadow: a fault by name, since when, and how sure."""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Alarm:
    """One alarm.

    Attributes:
        fault: Name of the fault, e.g. "stuck sensor 3".
        channel: Channel in which it shows: "proximity", "light", "wheels" or "line".
        since_ns: Time since when the fault explains the replies better than a sound robot does [ns].
        raised_ns: Time of the alarm [ns].
        sureness: Probability of the fault, among all that were considered.
        ended_ns: Time of its end [ns]; None while it lasts.
    """

    fault: str
    channel: str
    since_ns: int
    raised_ns: int
    sureness: float
    ended_ns: int | None = None
