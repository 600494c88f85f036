"""Execution of a sweep's tasks by Ray, on this machine or on an existing cluster.

On this machine Ray listens on loopback only, requires a random token, and has no dashboard. An existing
cluster is joined with its token. A task whose worker dies is run again; workers write no files.
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
from khep_twin.process.machine import n_cores
from khep_twin.sweep.results import encode_part
from khep_twin.sweep.run_shard import run_shard
from khep_twin.sweep.shards import Shard, Work, versions
from khep_twin.sweep.sweep import Executor

MAX_RETRIES = 30
"""Number of workers that a task may lose before the sweep stops (assumed)."""

TASKS_PER_CORE = 2
"""Number of tasks submitted per core: one running, one queued."""

LOOPBACK = "127.0.0.1"

_RAY_ENVIRONMENT = {"RAY_AUTH_MODE": "token", "RAY_USAGE_STATS_ENABLED": "0"}
"""Ray's environment variables, unless the user has set them."""

CLUSTER_TIMEOUT_S = 5.0
"""Timeout for a cluster's answer [s] (assumed); Ray itself would try for minutes."""

_LOOPBACK_SWITCH = "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"
"""Variable that, set to 0, makes Ray bind to loopback; Linux has no other switch for this."""

_NICENESS = "RAY_worker_niceness"
"""Variable of the workers' niceness; at Ray's default of 15 other processes starve them."""


def on_ray(address: str | None = None, workers: int | None = None) -> Executor:
    """Return Ray's workers, one for each core.

    Args:
        address: Address of an existing cluster, HOST:PORT, or "auto" for this machine's cluster; by default
            Ray is started here for the duration of the sweep.
        workers: Number of workers, if Ray is started here; by default one per core.

    Raises:
        MissingExtraError: ray is not installed.
    """
    variables = {name: value for name, value in _RAY_ENVIRONMENT.items() if name not in os.environ}
    if address is None:
        if "RAY_AUTH_TOKEN" not in os.environ:
            variables["RAY_AUTH_TOKEN"] = secrets.token_hex(32)
        variables |= {_LOOPBACK_SWITCH: "0"} | ({_NICENESS: "0"} if _NICENESS not in os.environ else {})
        if "ray" in sys.modules:
            raise KhepTwinError("ray is imported already and may listen to others; expected a new process")
    # Ray reads some of these at import, and its processes at their start.
    os.environ.update(variables)
    try:
        import ray
        import ray.exceptions
    except ImportError as error:
        for name in variables:
            del os.environ[name]
        raise MissingExtraError("ray", "ray") from error

    @contextmanager
    def run_tasks(work: Work, tasks: Sequence[Shard]) -> Generator[Iterable[tuple[Shard, bytes]]]:
        try:
            _connect(ray, address, workers)
            yield _collect_results(ray, work, tasks)
        except (ray.exceptions.RayError, ConnectionError) as error:
            raise KhepTwinError(f"ray: {_sentence(error)}; finished tasks are kept for --resume") from error
        finally:
            ray.shutdown()

    return run_tasks


def host_and_port(address: str) -> tuple[str, int]:
    """Return both parts of HOST:PORT."""
    host, _, port = address.rpartition(":")
    if not host or "/" in host or not port.isdecimal() or not 0 < int(port) < 2**16:
        raise ValueError(f"{address}: expected HOST:PORT, such as 10.0.0.1:6379, or auto")
    return host.strip("[]"), int(port)


def _connect(ray: ModuleType, address: str | None, workers: int | None) -> None:
    """Start Ray here, or join a cluster."""
    log_options: dict[str, object] = {"log_to_driver": False, "logging_level": "ERROR"}
    try:
        if address is not None:
            if address != "auto":
                host, port = host_and_port(address)
                socket.create_connection((host, port), CLUSTER_TIMEOUT_S).close()
            ray.init(address=address, **log_options)
            return
        n_workers = workers or n_cores()
        # "local" ignores a cluster that the environment may name.
        ray_context = ray.init(address="local", num_cpus=n_workers, include_dashboard=False, **log_options)
    except (ValueError, RuntimeError, OSError) as error:
        if address is None:
            raise KhepTwinError(f"ray: cannot be started here: {_sentence(error)}") from error
        raise KhepTwinError(
            f"ray: no cluster can be joined at {address}: {_sentence(error)}; expected a running one, "
            "and its token"
        ) from error
    if ray_context.address_info["node_ip_address"] != LOOPBACK:
        raise KhepTwinError(
            f"ray: listens at {ray_context.address_info['node_ip_address']}; expected {LOOPBACK} alone"
        )


def _collect_results(ray: ModuleType, work: Work, tasks: Sequence[Shard]) -> Iterator[tuple[Shard, bytes]]:
    """Yield the tasks' results as they arrive."""
    # A task that requests no GPU sees none.
    gpu_options = {"num_gpus": 1} if work.study.device == "cuda" else {}
    remote_task = ray.remote(num_cpus=1, max_retries=MAX_RETRIES, **gpu_options)(_run_task)
    work_reference = ray.put(work)
    queue = iter(tasks)
    pending: dict[object, Shard] = {}
    while True:
        # A cluster may grow during the sweep.
        capacity = TASKS_PER_CORE * max(int(ray.cluster_resources().get("CPU", 1)), 1)
        while len(pending) < capacity and (task := next(queue, None)) is not None:
            pending[remote_task.remote(work_reference, task)] = task
        if not pending:
            return
        ready, _ = ray.wait(list(pending), num_returns=1, timeout=10)
        for reference in ready:
            task = pending.pop(reference)
            try:
                data, message = ray.get(reference)
            except ray.exceptions.WorkerCrashedError as error:
                raise KhepTwinError(
                    f"ray: task {task.index} has lost its worker {MAX_RETRIES + 1} times, as if it killed "
                    "it; finished tasks are kept for --resume"
                ) from error
            if message:
                raise KhepTwinError(message)
            yield task, data


def _run_task(work: Work, task: Shard) -> tuple[bytes, str]:
    """Run a task in a worker; return its results and an error message."""
    if work.versions != versions():
        return b"", f"ray: a worker has {versions()}; expected {work.versions}, as here"
    try:
        return encode_part(work, task, run_shard(work, task)), ""
    except KhepTwinError as error:
        return b"", str(error)


def _sentence(error: BaseException) -> str:
    """Return the first sentence of an error's message, without Ray's traceback."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    line = next((line.strip() for line in str(error).splitlines() if line.strip()), type(error).__name__)
    return line.partition(". ")[0].rstrip(".")
