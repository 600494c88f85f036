"""The table of message types, against the definitions that ROS 2 publishes."""

import re

import pytest
from rosbags.typesys import Stores, get_typestore

from khep_twin.log.message_types import SCHEMAS, fields_of, type_hash

STORES = [get_typestore(store) for store in (Stores.ROS2_JAZZY, Stores.ROS2_KILTED)]

SERVICES = {
    "std_srvs/srv/SetBool": "abe9e4bb6b41b40e6789712c00ec8871923e089af3f667a79992a428cff2da0a",
    "std_srvs/srv/Trigger": "eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f",
}
"""Hashes that nodes of Jazzy show."""

RELEASED = [name for name in SCHEMAS if not name.startswith(("foxglove_msgs/", "service_msgs/"))]
"""Types of a distribution whose hash the other library computes; it has another number for `char`."""


@pytest.mark.parametrize("name", RELEASED)
def test_a_type_is_the_one_of_the_distributions(name: str) -> None:
    for store in STORES:
        assert type_hash(name) == store.hash_rihs01(name)
        published = [field for field, _ in store.fielddefs[name][1]]
        assert [field.name for field in fields_of(name)] == published


@pytest.mark.parametrize(("name", "expected"), SERVICES.items())
def test_a_service_has_the_published_hash(name: str, expected: str) -> None:
    assert type_hash(name) == f"RIHS01_{expected}"


@pytest.mark.parametrize("name", SCHEMAS)
def test_a_schema_defines_each_type_that_it_names(name: str) -> None:
    defined = set(re.findall(r"^MSG: (\S+)$", SCHEMAS[name], re.MULTILINE))
    named = {word.partition("[")[0] for word in re.findall(r"^(\w+/\S+) ", SCHEMAS[name], re.MULTILINE)}
    assert named == defined


def test_an_unknown_type_is_an_error() -> None:
    with pytest.raises(KeyError, match="std_msgs/Int7"):
        fields_of("std_msgs/msg/Int7")
