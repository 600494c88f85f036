"""Quality of service in logs, as rosbags reads it."""

import pytest
from rosbags.rosbag2.metadata import dump_qos_v8, parse_qos

from khep_twin.log import qos
from khep_twin.log.qos import Qos


@pytest.mark.parametrize("profile", [qos.DEFAULT, qos.SENSOR, qos.LATCHED, qos.CLOCK, qos.TF])
def test_another_library_reads_the_quality_of_service_of_a_bag(profile: Qos) -> None:
    [read] = parse_qos(profile.rosbag2_text())
    assert read.depth == profile.depth
    assert read.reliability.value == profile.reliability
    assert read.durability.value == profile.durability
    assert parse_qos(dump_qos_v8([read])) == [read]
    assert read.deadline == read.lifespan == read.liveliness_lease_duration
    assert (read.deadline.sec, read.deadline.nsec) == (2**63 // 10**9, 2**63 % 10**9 - 1)
