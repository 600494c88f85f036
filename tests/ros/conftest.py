"""Fixtures of the tests of nodes of ROS 2."""

import pytest


@pytest.fixture(autouse=True)
def no_settings_of_ros(monkeypatch: pytest.MonkeyPatch) -> None:
    """Use no settings of an installation of ROS on this machine."""
    files = "ZENOH_SESSION_CONFIG_URI", "ZENOH_ROUTER_CONFIG_URI"
    for name in ("ROS_DOMAIN_ID", "ZENOH_CONFIG_OVERRIDE", *files):
        monkeypatch.delenv(name, raising=False)
