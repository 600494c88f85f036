"""Checks of a recording, in the order of their report."""

from khep_twin.lab.conformance.recording import (
    replies,
    sensors,
    statuses,
    times,
    versions,
    wheels,
)
from khep_twin.lab.conformance.recording.check import RecordingCheck

CHECKS: tuple[RecordingCheck, ...] = (
    replies.answers,
    replies.unasked_lines,
    replies.letters,
    replies.plain_integers,
    replies.ranges,
    replies.refusals,
    replies.wrong_parameters,
    replies.unknown_words,
    replies.missing_devices,
    replies.turrets,
    replies.tools,
    versions.versions,
    versions.banner,
    times.too_early,
    times.too_late,
    wheels.counters_without_jumps,
    wheels.set_counters,
    wheels.counters_after_restart,
    wheels.counters_by_measured_speeds,
    wheels.counters_by_setpoints,
    wheels.speeds_by_setpoints,
    statuses.modes,
    statuses.flags,
    statuses.errors,
    statuses.counters_on_target,
    statuses.arrival_in_time,
    sensors.one_scan,
    sensors.stuck_sensors,
    sensors.frozen_readings,
)
"""All checks. One that is written is added here."""
