"""Ray does a sweep's tasks: on this machine, or on a cluster that is there.

On this machine it listens on loopback alone, asks for a token that this process draws anew, and has no
dashboard. A cluster is joined with the token that it was started with. A task whose worker dies is begun
again; whoever lost it has written nothing down.
"""

# ray is not installed everywhere.
# pyright: reportMissingImports=false, reportMissingTypeStubs=false, reportUnknownMemberType=false
# pyright: reportUnknownVariableType=false, reportUnknownArgumentType=false

import os
import secrets
import socket
import sys
from collections.abc import Generator, Iterable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from khep_twin.errors import KhepTwinError, MissingExtraError
from khep_twin.sweep.results import encoded
from khep_twin.sweep.sweep import Doers
from khep_twin.sweep.task_lives import results
from khep_twin.sweep.tasks import Task, Work, versions

MOST_RETRIES = 30
"""So often a task may lose its worker before it counts as what kills workers (assumed)."""

AHEAD = 2
"""Tasks that are handed out for each core: one to work at, one to go on with."""

LOOPBACK = "127.0.0.1"

_HERE = {"RAY_AUTH_MODE": "token", "RAY_USAGE_STATS_ENABLED": "0"}
"""What Ray is told where the user has not said otherwise."""

PATIENCE = 5.0
"""How long a cluster may take to answer [s] (assumed); Ray itself would try for minutes."""

_ALONE = "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"
"""Ray binds to loopback where it is not to make clusters; on Linux it has no other switch for that."""

_NICENESS = "RAY_worker_niceness"
"""Ray lets its workers stand back (15): beside anything else that works they would hardly get on."""


def on_ray(address: str | None = None, workers: int | None = None) -> Doers:
    """Ray's workers, one for each core.

    Args:
        address: of a cluster that is there, HOST:PORT, or "auto" for the one that this machine belongs to;
            without, Ray is started here for as long as it is needed.
        workers: how many, if it is started here; without, as many as there are cores.

    Raises:
        MissingExtraError: ray is not installed.
    """
    given = {name: value for name, value in _HERE.items() if name not in os.environ}
    if address is None:
        if "RAY_AUTH_TOKEN" not in os.environ:
            given["RAY_AUTH_TOKEN"] = secrets.token_hex(32)
        given |= {_ALONE: "0"} | ({_NICENESS: "0"} if _NICENESS not in os.environ else {})
        if "ray" in sys.modules:
            raise KhepTwinError("ray is imported already and may listen to others; right is a new process")
    # Ray reads some of it when it is imported, and its processes when they start.
    os.environ.update(given)
    try:
        import ray
        import ray.exceptions
    except ImportError as error:
        for name in given:
            del os.environ[name]
        raise MissingExtraError("ray", "ray") from error

    @contextmanager
    def done(work: Work, tasks: Sequence[Task]) -> Generator[Iterable[tuple[Task, bytes]]]:
        try:
            _join(ray, address, workers)
            yield _coming(ray, work, tasks)
        except (ray.exceptions.RayError, ConnectionError) as error:
            raise KhepTwinError(f"ray: {_sentence(error)}; what was done is kept for --resume") from error
        finally:
            ray.shutdown()

    return done


def host_and_port(address: str) -> tuple[str, int]:
    """Both parts of HOST:PORT.

    Raises:
        ValueError: it is something else.
    """
    host, _, port = address.rpartition(":")
    if not host or "/" in host or not port.isdecimal() or not 0 < int(port) < 2**16:
        raise ValueError(f"{address}: right is HOST:PORT, such as 10.0.0.1:6379, or auto")
    return host.strip("[]"), int(port)


def _join(ray: Any, address: str | None, workers: int | None) -> None:
    """Starts Ray here, or joins a cluster."""
    quiet: dict[str, Any] = {"log_to_driver": False, "logging_level": "ERROR"}
    try:
        if address is not None:
            if address != "auto":
                host, port = host_and_port(address)
                socket.create_connection((host, port), PATIENCE).close()
            ray.init(address=address, **quiet)
            return
        count = workers or len(os.sched_getaffinity(0))
        # "local" takes no cluster that the environment may name.
        found = ray.init(address="local", num_cpus=count, include_dashboard=False, **quiet)
    except (ValueError, RuntimeError, OSError) as error:
        if address is None:
            raise KhepTwinError(f"ray: cannot be started here: {_sentence(error)}") from error
        raise KhepTwinError(
            f"ray: no cluster can be joined at {address}: {_sentence(error)}; right is one that is there, "
            "and its token"
        ) from error
    if found.address_info["node_ip_address"] != LOOPBACK:
        raise KhepTwinError(
            f"ray: it listens at {found.address_info['node_ip_address']}; right is {LOOPBACK} alone"
        )


def _coming(ray: Any, work: Work, tasks: Sequence[Task]) -> Iterator[tuple[Task, bytes]]:
    """The tasks' results as they come."""
    remote = ray.remote(num_cpus=1, max_retries=MOST_RETRIES)(_do)
    shared = ray.put(work)
    following = iter(tasks)
    pending: dict[Any, Task] = {}
    while True:
        # A cluster may grow meanwhile.
        room = AHEAD * max(int(ray.cluster_resources().get("CPU", 1)), 1)
        while len(pending) < room and (task := next(following, None)) is not None:
            pending[remote.remote(shared, task)] = task
        if not pending:
            return
        ready, _ = ray.wait(list(pending), num_returns=1, timeout=10)
        for each in ready:
            task = pending.pop(each)
            try:
                data, trouble = ray.get(each)
            except ray.exceptions.WorkerCrashedError as error:
                raise KhepTwinError(
                    f"ray: task {task.index} has lost its worker {MOST_RETRIES + 1} times, as if it killed "
                    "it; what was done is kept for --resume"
                ) from error
            if trouble:
                raise KhepTwinError(trouble)
            yield task, data


def _do(work: Work, task: Task) -> tuple[bytes, str]:
    """A task's results, or what was wrong; runs in a worker."""
    if work.versions != versions():
        return b"", f"ray: a worker has {versions()}; right is {work.versions}, as here"
    try:
        return encoded(work, task, results(work, task)), ""
    except KhepTwinError as error:
        return b"", str(error)


def _sentence(error: BaseException) -> str:
    """What happened, in a sentence and without Ray's traces."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    line = next((line.strip() for line in str(error).splitlines() if line.strip()), type(error).__name__)
    return line.partition(". ")[0].rstrip(".")
