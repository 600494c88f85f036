"""Simulated TCP sockets: the same calls give the same results on them and on those of the machine."""

import errno
import select
import socket
import struct
import time
from collections.abc import Callable
from typing import Any

import pytest

from checks.simulate.kernel import NS_PER_S
from checks.simulate.simulation import Simulation, simulate

Script = Callable[[Any, Any, Any], list[object]]


def on_the_machine(script: Script) -> list[object]:
    return script(socket, select, lambda: time.sleep(0.05))


def simulated(script: Script) -> list[object]:
    results: list[object] = []

    def scenario(simulation: Simulation, seconds: float) -> None:
        modules = simulation.system.modules
        results.clear()
        simulation.spawn(
            "host",
            lambda: results.extend(
                script(modules["socket"], modules["select"], lambda: modules["time"].sleep(0.05))
            ),
        )
        simulation.run(seconds)

    assert simulate("x", scenario, seed=0, seconds=100, allowed=()).violation is None
    return results


def outcome(call: Callable[[], object]) -> object:
    """Return what a call returns, or the class and number of its error."""
    try:
        return call()
    except OSError as error:
        return type(error), error.errno


def pair(module: Any) -> tuple[Any, Any, Any]:
    server = module.create_server(("127.0.0.1", 0))
    client = module.create_connection(server.getsockname()[:2], timeout=5)
    accepted, _ = server.accept()
    return server, client, accepted


def bytes_and_their_end(module: Any, select: Any, settle: Any) -> list[object]:
    server, client, accepted = pair(module)
    client.sendall(b"hello")
    client.shutdown(module.SHUT_WR)
    settle()
    results = [accepted.recv(3), accepted.recv(100), accepted.recv(100), accepted.send(b"bye")]
    settle()
    results += [client.recv(10), outcome(lambda: client.send(b"x"))]
    accepted.close()
    settle()
    results += [client.recv(10)]
    client.close()
    server.close()
    return results


def no_bytes_yet(module: Any, select: Any, settle: Any) -> list[object]:
    server, client, accepted = pair(module)
    accepted.setblocking(False)
    client.settimeout(0.02)
    server.setblocking(False)
    results = [outcome(lambda: accepted.recv(1)), outcome(lambda: client.recv(1)), outcome(server.accept)]
    results += [len(ready) for ready in select.select([accepted, server], [accepted], [], 0)]
    client.sendall(b"x")
    settle()
    results += [len(ready) for ready in select.select([accepted, server], [accepted], [], 0)]
    for endpoint in (server, client, accepted):
        endpoint.close()
    return [*results, outcome(lambda: client.recv(1))]


def closed_with_bytes_unread(module: Any, select: Any, settle: Any) -> list[object]:
    server, client, accepted = pair(module)
    accepted.sendall(b"before")
    client.sendall(b"unread")
    settle()
    accepted.close()
    settle()
    results = [
        outcome(lambda: client.recv(100)),
        outcome(lambda: client.recv(100)),
        outcome(lambda: client.recv(9)),
    ]
    results += [outcome(lambda: client.send(b"x")), outcome(lambda: client.shutdown(module.SHUT_RDWR))]
    client.close()
    server.close()
    return results


def sent_to_a_closed_end(module: Any, select: Any, settle: Any) -> list[object]:
    server, client, accepted = pair(module)
    accepted.close()
    settle()
    results = [client.send(b"x")]
    settle()
    results += [
        client.getsockopt(module.SOL_SOCKET, module.SO_ERROR),
        client.recv(10),
        outcome(lambda: client.send(b"y")),
    ]
    client.close()
    server.close()
    return results


def lingering_for_no_time(module: Any, select: Any, settle: Any) -> list[object]:
    server, client, accepted = pair(module)
    client.sendall(b"kept")
    settle()
    client.setsockopt(module.SOL_SOCKET, module.SO_LINGER, struct.pack("ii", 1, 0))
    client.close()
    settle()
    results = [accepted.getsockopt(module.SOL_SOCKET, module.SO_ERROR), accepted.recv(10), accepted.recv(10)]
    accepted.close()
    server.close()
    return results


def refused(module: Any, select: Any, settle: Any) -> list[object]:
    server = module.create_server(("127.0.0.1", 0))
    address = server.getsockname()[:2]
    second_server = outcome(lambda: module.create_server(address))
    server.close()
    results = [second_server, outcome(lambda: module.create_connection(address, timeout=5))]
    with module.socket(module.AF_INET, module.SOCK_STREAM) as host:
        host.setblocking(False)
        results += [host.connect_ex(address) in (errno.EINPROGRESS, errno.ECONNREFUSED)]
        settle()
        results += [host.getsockopt(module.SOL_SOCKET, module.SO_ERROR) in (0, errno.ECONNREFUSED)]
    return results


def left_before_it_was_accepted(module: Any, select: Any, settle: Any) -> list[object]:
    server = module.create_server(("127.0.0.1", 0))
    with module.create_connection(server.getsockname()[:2], timeout=5) as host:
        host.sendall(b"last")
    settle()
    accepted, _ = server.accept()
    results = [accepted.recv(10), accepted.recv(10)]
    accepted.close()
    server.close()
    return results


def no_room(module: Any, select: Any, settle: Any) -> list[object]:
    server, client, accepted = pair(module)
    client.settimeout(0.1)
    results = [outcome(lambda: client.sendall(bytes(50_000_000)))]
    results += [len(ready) for ready in select.select([], [client], [], 0)]
    for endpoint in (server, client, accepted):
        endpoint.close()
    return results


@pytest.mark.parametrize(
    "script",
    [
        bytes_and_their_end,
        no_bytes_yet,
        closed_with_bytes_unread,
        sent_to_a_closed_end,
        lingering_for_no_time,
        refused,
        left_before_it_was_accepted,
        no_room,
    ],
)
def test_simulated_sockets_do_what_the_machines_own_do(script: Script) -> None:
    assert simulated(script) == on_the_machine(script)


def test_a_pulled_cable_shows_by_retransmissions_and_a_silent_end_by_keepalive() -> None:
    results: list[object] = []

    def scenario(simulation: Simulation, seconds: float) -> None:
        modules, network = simulation.system.modules, simulation.network

        def host() -> None:
            simulated_socket, sleep = modules["socket"], modules["time"].sleep
            server, client, accepted = pair(simulated_socket)
            server.setsockopt(simulated_socket.SOL_SOCKET, simulated_socket.SO_KEEPALIVE, 1)
            silent = simulated_socket.create_connection(server.getsockname()[:2])
            connection, _ = server.accept()
            for name, value in (("KEEPIDLE", 10), ("KEEPINTVL", 5), ("KEEPCNT", 3)):
                connection.setsockopt(
                    simulated_socket.IPPROTO_TCP, getattr(simulated_socket, f"TCP_{name}"), value
                )
            for endpoint in (client, silent):
                network.cut(endpoint._tcp)
            accepted.send(b"lost")
            for _ in range(3):
                sleep(10)
                results.append(
                    accepted.getsockopt(simulated_socket.IPPROTO_TCP, simulated_socket.TCP_INFO, 3)[2]
                )
                results.append(connection.getsockopt(simulated_socket.SOL_SOCKET, simulated_socket.SO_ERROR))

        simulation.spawn("host", host)
        simulation.run(seconds)

    assert simulate("x", scenario, 1, 100, allowed=()).violation is None
    # After 0.2, 0.6, 1.4, 3, 6.2, 12.6 and 25.4 s; keepalive after 10 + 3 * 5 s.
    assert results == [5, 0, 6, 0, 7, errno.ETIMEDOUT]


def test_a_thread_shares_the_descriptors_of_its_process_and_ends_with_it() -> None:
    states: list[object] = []

    def scenario(simulation: Simulation, seconds: float) -> None:
        modules = simulation.system.modules

        def host() -> None:
            _server, client, accepted = pair(modules["socket"])
            messages = modules["queue"].Queue()

            def listen() -> None:
                while data := accepted.recv(10):
                    messages.put(data)

            thread = modules["threading"].Thread(target=listen, daemon=True)
            thread.start()
            client.sendall(b"x")
            states.append(messages.get(True, 5.0))
            with pytest.raises(modules["queue"].Empty):
                messages.get(True, 0.5)
            states.append(thread.is_alive())

        process = simulation.spawn("host", host)
        simulation.run(seconds)
        states.append([thread.alive for thread in process.threads])
        states.append(process.files)

    assert simulate("x", scenario, 1, NS_PER_S / 1e8, allowed=()).violation is None
    assert states == [b"x", True, [False], {}]
