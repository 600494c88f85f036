"""Checks of a recording, in the order of their report."""

from khep_twin.lab.conformance.recording import replies, sensors, statuses, times, versions, wheels
from khep_twin.lab.conformance.recording.check import RecordingCheck

CHECKS: tuple[RecordingCheck, ...] = tuple(
    value
    for module in (replies, versions, times, wheels, statuses, sensors)
    for value in vars(module).values()
    if isinstance(value, RecordingCheck)
)
"""All checks, in the order of these modules. A new module of checks is added here."""
