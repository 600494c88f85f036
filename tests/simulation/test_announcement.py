"""Compilations are announced once, with their duration and progress."""

import math
from collections.abc import Callable, Generator
from contextlib import contextmanager
from types import ModuleType
from typing import Any

import pytest
from numba_marks import with_numba

pytestmark = with_numba


class Dispatcher:
    """A compiled function, as in numba's events."""

    def __init__(self, function: Callable[..., Any]) -> None:
        self.py_func = function


class Compilations:
    """Fake compilation events of numba, and a clock that advances by a second for each inner function."""

    def __init__(self, inner: list[Callable[..., Any]]) -> None:
        self.now, self._inner = 100.0, iter(inner)

        self.share = 1.0  # of a processor

    def monotonic(self) -> float:
        return self.now

    def thread_time(self) -> float:
        return self.now * self.share

    def compile(self, outer: Dispatcher, n_inner: int) -> None:
        from numba.core import event

        with event.trigger_event("numba:compile", data={"dispatcher": outer}):
            for _ in range(n_inner):
                with event.trigger_event("numba:compile", data={"dispatcher": Dispatcher(next(self._inner))}):
                    self.now += 1


@pytest.fixture
def module() -> ModuleType:
    """Return a module of forty functions for compiled code."""
    forty = ModuleType("forty")
    for number in range(40):
        function: Any = eval("lambda x: 2 * x")
        function.__module__ = forty.__name__
        setattr(forty, f"f{number}", function)
    return forty


@pytest.fixture
def compilations(module: ModuleType, monkeypatch: pytest.MonkeyPatch) -> Compilations:
    """Return compilations of the functions of the module, in their order."""
    from khep_twin.simulation import announcement

    functions = [getattr(module, f"f{number}") for number in range(40)]
    fakes = Compilations(functions)
    monkeypatch.setattr(announcement, "FUNCTIONS", functions)
    monkeypatch.setattr(announcement, "time", fakes)
    return fakes


BEGIN = "khep_twin: compiling with numba, once per version: about 40 s of processor time\n"
"""Announcement after six of forty functions."""


def test_a_compilation_is_a_line_with_the_time_it_will_take_and_one_with_that_it_took(
    module: ModuleType, compilations: Compilations, capsys: pytest.CaptureFixture[str]
) -> None:
    from numba.core import event

    from khep_twin.simulation.announcement import Announcer

    announcer, outer = Announcer(), Dispatcher(math.sin)
    announcer.add(outer, [module])
    with event.install_listener("numba:compile", announcer):
        compilations.compile(outer, 3)  # too few for an estimate
        assert capsys.readouterr().err == ""
        compilations.compile(outer, 37)
    lines = capsys.readouterr().err.splitlines()
    assert lines == [
        "khep_twin: compiling with numba, once per version: about 37 s of processor time",
        "khep_twin: compiling with numba took 37 s",
    ]


def test_on_a_busy_machine_the_processor_time_is_announced_and_the_elapsed_time_at_the_end(
    module: ModuleType, compilations: Compilations, capsys: pytest.CaptureFixture[str]
) -> None:
    from numba.core import event

    from khep_twin.simulation.announcement import Announcer

    compilations.share = 0.25
    announcer, outer = Announcer(), Dispatcher(math.sin)
    announcer.add(outer, [module])
    with event.install_listener("numba:compile", announcer):
        compilations.compile(outer, 40)
    assert capsys.readouterr().err.splitlines() == [
        "khep_twin: compiling with numba, once per version: about 10 s of processor time",
        "khep_twin: compiling with numba took 40 s",
    ]


def test_several_compilations_together_are_announced_once_and_none_if_all_is_in_the_cache(
    module: ModuleType, compilations: Compilations, capsys: pytest.CaptureFixture[str]
) -> None:
    from numba.core import event

    from khep_twin.simulation.announcement import Announcer

    announcer, first, second = Announcer(), Dispatcher(math.sin), Dispatcher(math.cos)
    for outer in (first, second):
        announcer.add(outer, [module])
    with event.install_listener("numba:compile", announcer):
        with announcer.group([first, second]):
            compilations.compile(first, 20)
            compilations.compile(second, 20)
        assert capsys.readouterr().err == f"{BEGIN}khep_twin: compiling with numba took 40 s\n"
        with announcer.group([first, second]):
            pass
    assert capsys.readouterr().err == ""


def test_the_progress_is_the_part_of_the_functions_and_the_time_goes_by_what_they_took(
    module: ModuleType, compilations: Compilations, monkeypatch: pytest.MonkeyPatch
) -> None:
    from numba.core import event

    from khep_twin.simulation import announcement
    from khep_twin.simulation.announcement import Announcer

    texts: list[str] = []

    @contextmanager
    def record(
        begin: str, progress: Callable[[], str], end: Callable[[], str]
    ) -> Generator[None, None, None]:
        texts.append(progress())
        yield
        texts.append(progress())

    monkeypatch.setattr(announcement, "announced", record)
    announcer, outer = Announcer(), Dispatcher(math.sin)
    announcer.add(outer, [module])
    with event.install_listener("numba:compile", announcer):
        compilations.compile(outer, 30)
    assert [text.partition("version: ")[2] for text in texts] == [
        "15 %, about 34 s to go",
        "75 %, about 10 s to go",
    ]


def test_a_short_compilation_or_one_of_other_code_is_not_announced(
    capsys: pytest.CaptureFixture[str],
) -> None:
    from numba import njit

    from khep_twin.simulation.compiled import compiled

    twice = compiled(eval("lambda x: 2 * x"), ())
    assert (twice(1), twice(2)) == (2, 4)
    assert njit(lambda x: 3 * x)(1) == 3
    assert capsys.readouterr() == ("", "")


def test_all_parts_that_are_compiled_know_what_they_call() -> None:
    from khep_twin.simulation.announcement import ANNOUNCER
    from khep_twin.simulation.ready import CODE, function_of, functions_of

    for part in CODE:
        assert function_of(part) in functions_of(part)
        ANNOUNCER._set_expected(functions_of(part))
        assert len(ANNOUNCER._expected | ANNOUNCER._compiled) > 20, part
