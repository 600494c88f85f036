"""Simulated workers of a sweep: a Ray cluster, and a pool whose results come late and twice.

The cluster gives Ray's guarantees: a task whose worker dies is run again, up to a limit, and each reference
has one result. The tasks, and the sweep itself, are the product's code.
"""

from collections import deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import contextmanager
from types import ModuleType, SimpleNamespace
from typing import Any

from checks.simulate.kernel import NS_PER_S, OpenFile, Process
from checks.simulate.simulation import Simulation
from khep_twin.sweep.ray_workers import _run_task
from khep_twin.sweep.shards import Shard, Work
from khep_twin.sweep.sweep import Executor

PLACES = 3
"""Number of workers."""

TASK_S = 0.05, 2.0
"""Shortest and longest usual time of a task [s] (assumed)."""

MOST_KILLED, MOST_LATE, MOST_KILLERS, MOST_AWAY = 0.4, 0.3, 0.02, 0.2
"""Highest probabilities: a worker dies or is late, a task kills all its workers, a cluster is away."""

REASSIGNED_S = 5.0
"""Time after which a pool gives a task to another worker as well [s] (assumed)."""


class RayError(Exception):
    """Error of the simulated Ray."""


class WorkerCrashedError(RayError):
    """A task that has lost all its workers."""


class Reference:
    """Result of a task, which may not be there yet."""

    def __init__(self, action: Callable[[], Any], retries: int, deadly: bool) -> None:
        self.action, self.retries, self.deadly = action, retries, deadly
        self.result: tuple[Any, Exception | None] | None = None


class Cluster:
    """Workers of one sweep; each runs a task in a separate simulated process."""

    def __init__(self, simulation: Simulation, name: str) -> None:
        self.simulation, self.name = simulation, name
        self.news = OpenFile(simulation.kernel)
        self.alive = True
        self._waiting: deque[Reference] = deque()
        self._workers: list[Process] = []
        self._n_workers = 0

    def submit(self, reference: Reference) -> None:
        """Run a task as soon as there is a place."""
        self._waiting.append(reference)
        self._place()

    def running(self) -> list[Process]:
        """Return the workers that run."""
        return [worker for worker in self._workers if worker.alive]

    def end(self) -> None:
        """End all workers."""
        self.alive = False
        self._waiting.clear()
        for worker in self.running():
            self.simulation.kernel.kill(worker)

    def _place(self) -> None:
        self._workers = self.running()
        while self.alive and self._waiting and len(self._workers) < PLACES:
            self._workers.append(self._begin(self._waiting.popleft()))

    def _begin(self, reference: Reference) -> Process:
        """Start a worker, and draw its fate."""
        simulation, kernel = self.simulation, self.simulation.kernel
        faults = simulation.faults
        self._n_workers += 1
        name = f"{self.name} worker {self._n_workers}"
        duration = simulation.rng(name).uniform(*TASK_S)
        if faults.happens("worker-late", "workers", MOST_LATE):
            duration *= faults.drawn("worker-late", "workers").uniform(5, 50)
        dies = reference.deadly or faults.happens("worker-killed", "workers", MOST_KILLED)
        lived = faults.drawn("worker-killed", "workers").uniform(0, 1.1) if dies else 1.0

        def work() -> None:
            kernel.called()
            kernel.wait([], lambda: False, kernel.now_ns + round(min(lived, 1.0) * duration * NS_PER_S))
            if dies and lived <= 1:
                return
            result = reference.action()
            kernel.called()
            if not dies:  # otherwise its result is lost on the way
                reference.result = result, None
                simulation.count("tasks run")

        worker = simulation.spawn(name, work)
        worker.on_end = lambda process: self._ended(process, reference)
        return worker

    def _ended(self, worker: Process, reference: Reference) -> None:
        self.simulation.check_end(worker)
        if not self.alive:
            return
        if reference.result is None:
            self.simulation.count("workers lost")
            reference.retries -= 1
            if reference.retries >= 0:
                self._waiting.append(reference)
            else:
                reference.result = None, WorkerCrashedError("The worker died. It does so always.")
        self._place()
        self.news.changed()


class SimulatedRay(ModuleType):
    """Module `ray`: each simulated process that uses it has separate workers."""

    def __init__(self, simulation: Simulation) -> None:
        super().__init__("ray")
        self.exceptions = SimpleNamespace(RayError=RayError, WorkerCrashedError=WorkerCrashedError)
        self._simulation = simulation
        self.clusters: dict[Process, Cluster] = {}

    def _process(self) -> Process:
        return self._simulation.kernel.called()

    def init(self, **_: object) -> None:
        """Join the cluster."""
        process = self._process()
        if self._simulation.faults.happens("away", "cluster", MOST_AWAY):
            raise ConnectionError("ray client connection timeout. Is it running?")
        self.clusters[process] = Cluster(self._simulation, process.name)

    def shutdown(self) -> None:
        """Leave the cluster; Ray ends the tasks of a process that has left, or died."""
        self.left(self._process())

    def left(self, process: Process) -> None:
        """End the tasks of a process."""
        if (cluster := self.clusters.pop(process, None)) is not None:
            cluster.end()

    def put(self, value: object) -> object:
        """Keep a value."""
        self._process()
        return value

    def cluster_resources(self) -> dict[str, float]:
        """Return the number of cores."""
        return {"CPU": float(PLACES)}

    def remote(self, num_cpus: int, max_retries: int) -> Callable[[Callable[..., Any]], Any]:
        """Return a decorator of functions that workers run."""

        def decorated(function: Callable[..., Any]) -> Any:
            def submitted(*args: object) -> Reference:
                cluster = self.clusters[self._process()]
                deadly = self._simulation.faults.happens("deadly", "tasks", MOST_KILLERS)
                reference = Reference(lambda: function(*args), max_retries, deadly)
                cluster.submit(reference)
                return reference

            return SimpleNamespace(remote=submitted)

        return decorated

    def wait(
        self, references: Sequence[Reference], num_returns: int, timeout: float
    ) -> tuple[list[Reference], list[Reference]]:
        """Wait until a task has its result."""
        kernel, cluster = self._simulation.kernel, self.clusters[self._process()]

        def ready() -> list[Reference]:
            return [reference for reference in references if reference.result is not None][:num_returns]

        kernel.wait([cluster.news], lambda: bool(ready()), kernel.now_ns + round(timeout * NS_PER_S))
        finished = ready()
        return finished, [reference for reference in references if reference not in finished]

    def get(self, reference: Reference) -> object:
        """Return a task's result."""
        self._process()
        if self._simulation.faults.happens("lost", "cluster", MOST_AWAY / 10):
            raise RayError("The cluster is gone. It was restarted.")
        assert reference.result is not None
        value, error = reference.result
        if error is not None:
            raise error
        return value


def pool(simulation: Simulation, clusters: dict[Process, Cluster]) -> Executor:
    """Return workers of which some are abandoned early, so that their results come late, and twice."""
    kernel = simulation.kernel

    def coming(cluster: Cluster, work: Work, tasks: Sequence[Shard]) -> Iterator[tuple[Shard, bytes]]:
        assignments: list[tuple[Shard, Reference]] = []
        assigned_ns: dict[int, int] = {}

        def give(task: Shard) -> None:
            assigned_ns[task.index] = kernel.now_ns
            reference = Reference(lambda: _run_task(work, task), 1000, False)
            assignments.append((task, reference))
            cluster.submit(reference)

        for task in tasks:
            give(task)
        missing = {task.index: task for task in tasks}
        while missing:
            kernel.called()
            arrived = [assignment for assignment in assignments if assignment[1].result is not None]
            if not arrived:
                deadline_ns = kernel.now_ns + NS_PER_S
                kernel.wait(
                    [cluster.news], lambda: any(reference.result for _, reference in assignments), deadline_ns
                )
                late = [
                    index
                    for index in missing
                    if kernel.now_ns - assigned_ns[index] > REASSIGNED_S * len(tasks) * NS_PER_S
                ]
                for index in late:
                    give(missing[index])
                continue
            for assignment in arrived:
                assignments.remove(assignment)
                task, (answer, _) = assignment[0], assignment[1].result or ((b"", ""), None)
                if missing.pop(task.index, None) is None:
                    simulation.count("results twice")
                yield task, answer[0]
                if simulation.faults.happens("twice", "results", MOST_LATE):
                    simulation.count("results twice")
                    yield task, answer[0]

    @contextmanager
    def executor(work: Work, tasks: Sequence[Shard]) -> Generator[Iterable[tuple[Shard, bytes]]]:
        process = kernel.called()
        clusters[process] = cluster = Cluster(simulation, process.name)
        try:
            yield coming(cluster, work, tasks)
        finally:
            clusters.pop(process, None)
            cluster.end()

    return executor
