"""Quality of service of ROS 2 topics."""

from dataclasses import dataclass

RELIABLE, BEST_EFFORT = 1, 2
"""Numbers of the reliabilities in ROS's enumeration `rmw_qos_reliability_policy_e`."""

TRANSIENT_LOCAL, VOLATILE = 1, 2
"""Numbers of the durabilities in ROS's enumeration `rmw_qos_durability_policy_e`."""

_KEEP_LAST, _AUTOMATIC = 1, 1
"""Numbers of the only history and liveliness that this package uses."""

_INFINITE = "{sec: 9223372036, nsec: 854775807}"
"""Duration of ROS without an end."""


@dataclass(frozen=True, slots=True)
class Qos:
    """Quality of service of a topic: a history of the last messages, without deadlines.

    Attributes:
        depth: Number of messages in the history.
        is_reliable: Whether lost messages are sent again.
        is_latched: Whether a late subscriber receives the history ("transient local").
    """

    depth: int = 10
    is_reliable: bool = True
    is_latched: bool = False

    @property
    def reliability(self) -> int:
        """Number of the reliability."""
        return RELIABLE if self.is_reliable else BEST_EFFORT

    @property
    def durability(self) -> int:
        """Number of the durability."""
        return TRANSIENT_LOCAL if self.is_latched else VOLATILE

    def rosbag2_text(self) -> str:
        """Return a channel's `offered_qos_profiles`: YAML with one publisher and numbers for enumerations."""
        values = {
            "history": _KEEP_LAST,
            "depth": self.depth,
            "reliability": self.reliability,
            "durability": self.durability,
            "deadline": _INFINITE,
            "lifespan": _INFINITE,
            "liveliness": _AUTOMATIC,
            "liveliness_lease_duration": _INFINITE,
            "avoid_ros_namespace_conventions": "false",
        }
        return "- " + "\n  ".join(f"{key}: {value}" for key, value in values.items())


DEFAULT = Qos()
"""Profile of publishers, subscribers and services."""

SENSOR = Qos(depth=5, is_reliable=False)
"""Profile of sensor data."""

LATCHED = Qos(depth=1, is_latched=True)
"""Profile of topics with one lasting message, like `/robot_description` and `/tf_static`."""

CLOCK = Qos(depth=1, is_reliable=False)
"""Profile of `/clock`."""

TF = Qos(depth=100)
"""Profile of `/tf`."""

_BY_NAME = {name: LATCHED for name in ("robot_description", "channel_names", "scene", "tf_static")} | {
    "tf": TF,
    "clock": CLOCK,
}


def qos_of(topic: str) -> Qos:
    """Return the profile of a topic of a log or a node, by the last part of its name."""
    return _BY_NAME.get(topic.rpartition("/")[2], DEFAULT)
