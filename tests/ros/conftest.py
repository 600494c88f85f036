"""Fixtures of the tests of nodes of ROS 2."""

from collections.abc import Iterator

import pytest
from ros_network import DOMAIN, ForeignNode, Lines, free_port

from khep_twin.ros.graph import Graph
from khep_twin.ros.session import SessionMode


@pytest.fixture(autouse=True)
def no_settings_of_ros(monkeypatch: pytest.MonkeyPatch) -> None:
    """Use no settings of an installation of ROS on this machine."""
    files = "ZENOH_SESSION_CONFIG_URI", "ZENOH_ROUTER_CONFIG_URI"
    for name in ("ROS_DOMAIN_ID", "ZENOH_CONFIG_OVERRIDE", *files):
        monkeypatch.delenv(name, raising=False)


@pytest.fixture(scope="session")
def router() -> Iterator[Graph]:
    with Graph(f"127.0.0.1:{free_port()}", DOMAIN, mode=SessionMode.ROUTER) as graph:
        yield graph


@pytest.fixture(scope="session")
def foreign_process(router: Graph) -> Iterator[ForeignNode]:
    with ForeignNode(router.address) as node:
        yield node


@pytest.fixture
def foreign(foreign_process: ForeignNode) -> Iterator[ForeignNode]:
    yield foreign_process
    foreign_process.forget()


@pytest.fixture
def lines() -> Lines:
    return Lines()


@pytest.fixture
def graph(router: Graph, lines: Lines) -> Iterator[Graph]:
    with Graph(router.address, DOMAIN, report=lines.put) as client:
        yield client
