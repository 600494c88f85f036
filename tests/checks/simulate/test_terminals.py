"""Simulated pseudo-terminals against those of the machine: the same operations give the same results."""

import errno
import fcntl
import os
import random
import select
import struct
import termios
import time
from collections.abc import Callable
from itertools import pairwise
from types import ModuleType
from typing import Any

from checks.simulate.simulation import Simulation, simulate
from checks.simulate.terminals import CAPACITY, Terminals
from khep_twin.ports.event_sources import Event, OpenEvents, open_events

STEPS = 60
LONGEST_S = 2.0
"""Longest transit of bytes on the real terminal (assumed) [s]."""

_TIOCGEXCL = getattr(termios, "TIOCGEXCL", 0x80045440)
_FLAGS = os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK
_CONTROLS = termios.CSTOPB | termios.CSIZE | termios.PARENB | termios.CRTSCTS
_SPEEDS = termios.B9600, termios.B38400, termios.B115200

Settle = Callable[[Callable[[], list[int]]], object]
"""Function that waits until bytes in transit have arrived; it gets a function that counts what has."""


class Bench:
    """A terminal with a random sequence of operations, on either kernel."""

    def __init__(self, modules: dict[str, Any], seed: int, settle: Settle) -> None:
        self._os, self._select = modules["os"], modules["select"]
        self._termios, self._fcntl = modules["termios"], modules["fcntl"]
        self._rng, self._settle = random.Random(seed), settle
        self.results: list[object] = []
        self._master, first = self._os.openpty()
        self._hosts: list[int] = [first]
        self._path = self._os.ttyname(first)
        make_raw(self._termios, first)
        self._os.set_blocking(self._master, False)
        self._os.set_blocking(first, False)
        self._events = open_events(self._path)
        self._locked = False

    def run(self) -> None:
        """Do all operations; keep their results."""
        kinds = [self._open, self._close, self._write, self._write, self._answer, self._answer, self._read]
        kinds += [
            self._take,
            self._flush,
            self._set,
            self._lock,
            self._flock,
            self._look,
            self._stop,
            self._fill,
        ]
        for _ in range(STEPS):
            kind = self._rng.choice(kinds)
            try:
                result = kind()
            except (OSError, termios.error) as error:
                result = type(error), error.args[0]
            self.results.append((kind.__name__, result))
            self._settle(self._ready)
            self.results.append(self._state())
        assert isinstance(self._events, OpenEvents)
        self.results.append(_merged([*self._events.drain()]))
        self._events.close()
        for descriptor in [*self._hosts, self._master]:
            self._os.close(descriptor)

    def _ready(self) -> list[int]:
        return [
            self._request(descriptor, termios.FIONREAD) for descriptor in [self._master, *self._hosts[:1]]
        ]

    def _request(self, descriptor: int, request: int) -> int:
        return struct.unpack("i", self._fcntl.ioctl(descriptor, request, bytes(4)))[0]

    def _state(self) -> object:
        poll = self._select.poll()
        poll.register(self._master, select.POLLIN)
        for descriptor in self._hosts:
            poll.register(descriptor, select.POLLIN)
        ready = self._ready()
        return ready, sorted(state for _, state in poll.poll(0)), len(self._hosts)

    def _open(self) -> object:
        if len(self._hosts) < 4 and not self._locked:
            self._hosts.append(self._os.open(self._path, _FLAGS))
        return len(self._hosts)

    def _close(self) -> None:
        if self._hosts:
            self._os.close(self._hosts.pop(self._rng.randrange(len(self._hosts))))

    def _host(self) -> int:
        if not self._hosts:
            raise OSError(errno.ENOENT, "no host")
        return self._rng.choice(self._hosts)

    def _bytes(self) -> bytes:
        # Both kernels take so little at once whatever they hold.
        return self._rng.randbytes(self._rng.choice([1, 5, 60]))

    def _write(self) -> object:
        return self._os.write(self._host(), self._bytes())

    def _answer(self) -> object:
        return self._os.write(self._master, self._bytes())

    def _read(self) -> object:
        return self._os.read(self._master, self._rng.choice([1, 7, 1000]))

    def _take(self) -> object:
        return self._os.read(self._host(), self._rng.choice([1, 7, 1000]))

    def _flush(self) -> None:
        queue = self._rng.choice([termios.TCIFLUSH, termios.TCOFLUSH, termios.TCIOFLUSH])
        self._termios.tcflush(self._rng.choice([self._master, self._host()]), queue)

    def _set(self) -> object:
        descriptor = self._rng.choice([self._master, self._host()])
        flags = self._termios.tcgetattr(descriptor)
        flags[2] ^= self._rng.choice([termios.CSTOPB, termios.CRTSCTS])
        flags[4] = flags[5] = self._rng.choice(_SPEEDS)
        flags[6][termios.VMIN] = self._rng.choice([0, 1])
        self._termios.tcsetattr(descriptor, self._rng.choice([termios.TCSANOW, termios.TCSAFLUSH]), flags)
        return self._read_settings(self._master), self._read_settings(self._host())

    def _read_settings(self, descriptor: int) -> object:
        flags = self._termios.tcgetattr(descriptor)
        return flags[2] & _CONTROLS, flags[4:6], flags[6][termios.VMIN]

    def _lock(self) -> object:
        descriptor = self._host()
        self._locked = not self._locked
        self._fcntl.ioctl(descriptor, termios.TIOCEXCL if self._locked else termios.TIOCNXCL)
        return self._request(descriptor, _TIOCGEXCL)

    def _flock(self) -> None:
        operation = self._rng.choice([fcntl.LOCK_EX, fcntl.LOCK_EX, fcntl.LOCK_UN])
        self._fcntl.flock(self._host(), operation | fcntl.LOCK_NB)

    def _stop(self) -> None:
        self._termios.tcflow(self._host(), self._rng.choice([termios.TCOOFF, termios.TCOON, termios.TCOON]))

    def _fill(self) -> object:
        # More than is ready at once, and less than finds room, if nothing of the kind is there yet.
        descriptor = self._rng.choice([self._master, self._host()])
        reader = self._hosts[0] if descriptor == self._master else self._master
        return (
            self._os.write(descriptor, self._rng.randbytes(5000))
            if not self._request(reader, termios.FIONREAD)
            else 0
        )

    def _look(self) -> object:
        descriptor = self._host()
        refused: list[object] = []
        for request in (termios.TIOCMGET, termios.TIOCMBIS):
            try:
                self._fcntl.ioctl(descriptor, request, bytes(4))
            except OSError as error:
                refused.append(error.errno)
        return self._request(descriptor, termios.TIOCOUTQ), refused


def make_raw(module: Any, descriptor: int) -> None:
    """Make a terminal raw by either module `termios`."""
    flags = module.tcgetattr(descriptor)
    flags[0] = flags[1] = flags[3] = 0
    flags[2] = termios.CS8 | termios.CREAD
    flags[6][termios.VMIN], flags[6][termios.VTIME] = 1, 0
    module.tcsetattr(descriptor, termios.TCSANOW, flags)


def test_random_operations_give_the_same_results_as_on_the_machines_own_terminals() -> None:
    for seed in range(40):
        arrivals: list[list[int]] = []
        simulated = _on_the_simulated(seed, arrivals)
        real = _on_the_machine(seed, iter(arrivals))
        first = next(
            (pair for pair in enumerate(zip(simulated, real, strict=True)) if pair[1][0] != pair[1][1]), None
        )
        assert first is None, (seed, first, simulated[max(first[0] - 6, 0) : first[0]])


def test_a_full_terminal_takes_no_more() -> None:
    descriptors: list[int] = []

    def fill(modules: dict[str, Any]) -> None:
        os_ = modules["os"]
        master, host = os_.openpty()
        make_raw(modules["termios"], host)
        os_.set_blocking(master, False)
        count = 0
        while count < 1_000_000:
            try:
                count += os_.write(master, b"12345678")
            except BlockingIOError:
                break
        descriptors.append(count)
        os_.close(host)
        os_.close(master)

    fill({"os": os, "termios": termios})
    _in_a_simulation(0, fill)
    assert 13_000 < descriptors[0] < 21_000
    assert descriptors[1] == CAPACITY


def test_a_simulation_is_the_same_each_time() -> None:
    assert _on_the_simulated(3, []) == _on_the_simulated(3, [])


def _on_the_machine(seed: int, arrivals: Any) -> list[object]:
    def settle(ready: Callable[[], list[int]]) -> None:
        expected, end = next(arrivals), time.monotonic() + LONGEST_S
        while (ready_events := ready()) != expected:
            assert time.monotonic() < end, (seed, bench.results[-2:], ready_events, expected)

    modules: dict[str, ModuleType] = {"os": os, "select": select, "termios": termios, "fcntl": fcntl}
    bench = Bench(modules, seed, settle)
    bench.run()
    return bench.results


def _on_the_simulated(seed: int, arrivals: list[list[int]]) -> list[object]:
    results: list[object] = []

    def work(modules: dict[str, Any]) -> None:
        def settle(ready: Callable[[], list[int]]) -> None:
            modules["time"].sleep(0.1)
            arrivals.append(ready())

        bench = Bench(modules, seed, settle)
        bench.run()
        results.extend(bench.results)

    _in_a_simulation(seed, work)
    return results


def _in_a_simulation(seed: int, work: Callable[[dict[str, Any]], None]) -> None:
    def scenario(simulation: Simulation, seconds: float) -> None:
        with Terminals(simulation).installed():
            simulation.spawn("bench", lambda: work(simulation.system.modules))
            simulation.run(seconds)

    outcome = simulate("terminals", scenario, seed, 60.0, allowed=[])
    assert outcome.violation is None, outcome.violation


def _merged(events: list[Event]) -> list[Event]:
    """Return events with one write for each run of writes: others' terminals may stand between them."""
    distinct = [second for first, second in pairwise([None, *events]) if not first is second is Event.WRITTEN]
    return [event for event in distinct if event is not None]
