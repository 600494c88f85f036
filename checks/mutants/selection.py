"""Tests of a mutant: those that reach its line, nearest and fastest first."""

import hashlib
import json
from pathlib import Path

import coverage

BUDGET_S = 30.0
"""Longest time of a mutant's tests together, as recorded [s]."""

TESTS_LIMIT = 300
"""Most tests of a mutant."""


class Recorded:
    """Recording of the tests: their outcomes, times, and the lines that they reach.

    A file that has changed since counts as a whole: its mutants get the tests of all its lines, and a test
    file all its tests.

    Args:
        folder: Folder that `record` has filled.
        tree: Tree of the present sources.
    """

    def __init__(self, folder: Path, tree: Path) -> None:
        self._tree = tree
        self._digests: dict[str, str] = json.loads((folder / "digests.json").read_text())
        outcomes: dict[str, tuple[str, float]] = json.loads((folder / "outcomes.json").read_text())
        self._times_s = {test: time for test, (outcome, time) in outcomes.items() if outcome == "passed"}
        self._lines = coverage.CoverageData(str(folder / "lines"))
        self._lines.read()
        self._new_files = sorted(
            path.relative_to(tree).as_posix()
            for path in (tree / "tests").rglob("test_*.py")
            if self._is_changed(path.relative_to(tree).as_posix())
        )

    def tests(self, path: str, line: int) -> list[str]:
        """Return the tests of a line in the order of their runs; those of its folder if none reach it."""
        contexts_by_line = self._lines.contexts_by_lineno(path)
        lines = [*contexts_by_line] if self._is_changed(path) else [line]
        contexts = {context for number in lines for context in contexts_by_line.get(number, ())}
        tests = {test for test in self._times_s if test in contexts or _file_of(test) in contexts}
        folder = f"tests/{Path(path).parent.relative_to('khep_twin').as_posix()}/".replace("/./", "/")
        if not tests:
            tests = {test for test in self._times_s if Path(test.partition("::")[0]).parent == Path(folder)}
        tests = {test for test in tests if _file_of(test) not in self._new_files}
        new_files = [file for file in self._new_files if file.startswith(folder)]

        def rank(test: str) -> tuple[bool, bool, float]:
            is_mirror = _file_of(test) == f"{folder}test_{Path(path).name}"
            return not is_mirror, not test.startswith(folder), self._times_s[test]

        chosen: list[str] = new_files[:20]
        time_s = 0.0
        for test in sorted(tests, key=rank)[:TESTS_LIMIT]:
            time_s += self._times_s[test]
            if time_s < BUDGET_S:
                chosen.append(test)
        return chosen

    def is_reached(self, path: str, line: int) -> bool:
        """Return whether a recorded test reaches a line in its process."""
        return self._is_changed(path) or bool(self._lines.contexts_by_lineno(path).get(line))

    def _is_changed(self, path: str) -> bool:
        return self._digests.get(path) != digest(self._tree / path)


def digest(path: Path) -> str:
    """Return a digest of a file's content."""
    return hashlib.sha256(path.read_bytes()).hexdigest()


def _file_of(test: str) -> str:
    return test.partition("::")[0]
