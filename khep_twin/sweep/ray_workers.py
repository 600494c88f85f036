"""Execution of a sweep's tasks by Ray, on this machine or on an existing cluster.

On this machine Ray listens on loopback alone, requires a token that this process draws at random, and has no
dashboard. A cluster is joined with the token that it was started with. A task whose worker dies is run again;
workers write no files.
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
from types import ModuleType

from khep_twin.errors import KhepTwinError, MissingExtraError
from khep_twin.machine import n_cores
from khep_twin.sweep.results import encoded
from khep_twin.sweep.run_shard import run_shard
from khep_twin.sweep.shards import Shard, Work, versions
from khep_twin.sweep.sweep import Executor

MOST_RETRIES = 30
"""Most workers that a task may lose before it counts as their killer (assumed)."""

AHEAD = 2
"""Tasks submitted for each core: one to run, one to wait."""

LOOPBACK = "127.0.0.1"

_HERE = {"RAY_AUTH_MODE": "token", "RAY_USAGE_STATS_ENABLED": "0"}
"""Environment variables of Ray that are set unless the user has set them."""

CLUSTER_TIMEOUT_S = 5.0
"""Timeout for a cluster's answer [s] (assumed); Ray itself would try for minutes."""

_ALONE = "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"
"""Variable that makes Ray bind to loopback when it forbids clusters; Linux has no other switch for that."""

_NICENESS = "RAY_worker_niceness"
"""Variable of the workers' niceness; at Ray's default of 15 they hardly run beside other processes."""


def on_ray(address: str | None = None, workers: int | None = None) -> Executor:
    """Return Ray's workers, one for each core.

    Args:
        address: Address of an existing cluster, HOST:PORT, or "auto" for the one that this machine belongs
            to; by default Ray is started here for as long as it is needed.
        workers: Number of workers, if Ray is started here; by default one per core.

    Raises:
        MissingExtraError: ray is not installed.
    """
    given = {name: value for name, value in _HERE.items() if name not in os.environ}
    if address is None:
        if "RAY_AUTH_TOKEN" not in os.environ:
            given["RAY_AUTH_TOKEN"] = secrets.token_hex(32)
        given |= {_ALONE: "0"} | ({_NICENESS: "0"} if _NICENESS not in os.environ else {})
        if "ray" in sys.modules:
            raise KhepTwinError("ray is imported already and may listen to others; expected a new process")
    # Ray reads some of these when it is imported, and its processes when they start.
    os.environ.update(given)
    try:
        import ray
        import ray.exceptions
    except ImportError as error:
        for name in given:
            del os.environ[name]
        raise MissingExtraError("ray", "ray") from error

    @contextmanager
    def done(work: Work, tasks: Sequence[Shard]) -> Generator[Iterable[tuple[Shard, bytes]]]:
        try:
            _join(ray, address, workers)
            yield _coming(ray, work, tasks)
        except (ray.exceptions.RayError, ConnectionError) as error:
            raise KhepTwinError(f"ray: {_sentence(error)}; finished tasks are kept for --resume") from error
        finally:
            ray.shutdown()

    return done


def host_and_port(address: str) -> tuple[str, int]:
    """Return both parts of HOST:PORT."""
    host, _, port = address.rpartition(":")
    if not host or "/" in host or not port.isdecimal() or not 0 < int(port) < 2**16:
        raise ValueError(f"{address}: expected HOST:PORT, such as 10.0.0.1:6379, or auto")
    return host.strip("[]"), int(port)


def _join(ray: ModuleType, address: str | None, workers: int | None) -> None:
    """Start Ray here, or join a cluster."""
    quiet: dict[str, object] = {"log_to_driver": False, "logging_level": "ERROR"}
    try:
        if address is not None:
            if address != "auto":
                host, port = host_and_port(address)
                socket.create_connection((host, port), CLUSTER_TIMEOUT_S).close()
            ray.init(address=address, **quiet)
            return
        count = workers or n_cores()
        # "local" ignores a cluster that the environment may name.
        found = ray.init(address="local", num_cpus=count, include_dashboard=False, **quiet)
    except (ValueError, RuntimeError, OSError) as error:
        if address is None:
            raise KhepTwinError(f"ray: cannot be started here: {_sentence(error)}") from error
        raise KhepTwinError(
            f"ray: no cluster can be joined at {address}: {_sentence(error)}; expected a running one, "
            "and its token"
        ) from error
    if found.address_info["node_ip_address"] != LOOPBACK:
        raise KhepTwinError(
            f"ray: listens at {found.address_info['node_ip_address']}; expected {LOOPBACK} alone"
        )


def _coming(ray: ModuleType, work: Work, tasks: Sequence[Shard]) -> Iterator[tuple[Shard, bytes]]:
    """Yield the tasks' results as they arrive."""
    # A task that asks for no card sees none.
    cards = {"num_gpus": 1} if work.study.device == "cuda" else {}
    remote = ray.remote(num_cpus=1, max_retries=MOST_RETRIES, **cards)(_do)
    shared = ray.put(work)
    following = iter(tasks)
    pending: dict[object, Shard] = {}
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
                    "it; finished tasks are kept for --resume"
                ) from error
            if trouble:
                raise KhepTwinError(trouble)
            yield task, data


def _do(work: Work, task: Shard) -> tuple[bytes, str]:
    """Run a task in a worker; return its results and an error message."""
    if work.versions != versions():
        return b"", f"ray: a worker has {versions()}; expected {work.versions}, as here"
    try:
        return encoded(work, task, run_shard(work, task)), ""
    except KhepTwinError as error:
        return b"", str(error)


def _sentence(error: BaseException) -> str:
    """Return an error's message as one sentence, without Ray's traces."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    line = next((line.strip() for line in str(error).splitlines() if line.strip()), type(error).__name__)
    return line.partition(". ")[0].rstrip(".")
