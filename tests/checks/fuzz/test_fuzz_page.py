"""A share of fuzz-page: requests to the designer's page end in answers, and strangers are refused."""

import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from checks.fuzz.libfuzzer import run_libfuzzer
from checks.fuzz.page import check, designer, seeds
from checks.fuzz.page_recipes import ACTIONS, HEADERS, ODD, RUNS
from khep_twin.errors import KhepTwinError
from khep_twin.web import answers, file_actions, routes, session_actions
from khep_twin.web.documents import Documents
from khep_twin.web.guard import Guard

SHARE = 1_000


@pytest.fixture(name="page_alone")
def _page_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """Restore the functions that the designer in memory replaces after the test."""
    for place, name in (
        (answers, "run_in_threadpool"),
        (session_actions, "TwinActor"),
        (session_actions, "RobotActor"),
        (routes, "Challenges"),
        (file_actions, "render"),
    ):
        monkeypatch.setattr(place, name, getattr(place, name))
    designer()[2].patch_slow_parts()


@pytest.mark.long
def test_a_share_of_the_fuzzing_finds_nothing(tmp_path: Path) -> None:
    run_libfuzzer("fuzz-page", SHARE, tmp_path)


def test_random_requests_end_in_answers(page_alone: None) -> None:
    rng = random.Random(1)
    for _ in range(30):
        check(rng.randbytes(rng.randrange(1, 60)))


def test_the_pages_own_requests_are_answered_with_and_without_a_twin(
    page_alone: None, tmp_path: Path
) -> None:
    seeds(tmp_path)
    inputs = [path.read_bytes() for path in sorted(tmp_path.glob("request*"))]
    assert len(inputs) > 25
    for data in inputs:
        check(data)
        check(bytes([data[0] | RUNS]) + data[1:])


def test_every_action_of_the_page_is_fuzzed() -> None:
    assert set(ACTIONS) == set(routes.Page(Documents(Path()), None).actions)


def action(name: str, *steps: tuple[int, int, int, int]) -> bytes:
    """An input of one request, changed by steps."""
    return bytes([0, list(ACTIONS).index(name), len(steps), *(value for step in steps for value in step)])


def set_to(value: object) -> tuple[int, int, int, int]:
    """A step that gives the request's first key a value."""
    return 0, 0, next(place for place, odd in enumerate(ODD) if odd is value or odd == value), 0


def broken_guard(patch: pytest.MonkeyPatch) -> bytes:
    patch.setattr(Guard, "_refusal", lambda *_: (0, ""))
    return action("list", (6, HEADERS.index(b"Origin"), 0, 0))


def links_followed(patch: pytest.MonkeyPatch) -> bytes:
    patch.setattr(Documents, "path", lambda self, name, *_: self.root / name)
    return action("open", set_to("link.toml"))


def parents_followed(patch: pytest.MonkeyPatch) -> bytes:
    patch.setattr(Documents, "path", lambda self, name, *_: self.root / name)
    return action("program", set_to("/etc/passwd"))


def failure(patch: pytest.MonkeyPatch) -> bytes:
    patch.setattr(Documents, "names", lambda *_: 1 // 0)
    return action("list")


def refused_after_writing(patch: pytest.MonkeyPatch) -> bytes:
    def save(self: Documents, name: str, *_: Any, **__: Any) -> str:
        (self.root / name).write_text("x")
        raise KhepTwinError("changed my mind")

    patch.setattr(Documents, "save", save)
    return action("save")


def unclear(patch: pytest.MonkeyPatch) -> bytes:
    def names(*_: Any) -> list[str]:
        raise KhepTwinError("")

    patch.setattr(Documents, "names", names)
    return action("list")


@pytest.mark.parametrize(
    "broken", [broken_guard, links_followed, parents_followed, failure, refused_after_writing, unclear]
)
def test_a_broken_page_is_a_finding(
    page_alone: None, monkeypatch: pytest.MonkeyPatch, broken: Callable[[pytest.MonkeyPatch], bytes]
) -> None:
    check(action("list"))
    data = broken(monkeypatch)
    with pytest.raises((AssertionError, ZeroDivisionError)):
        check(data)
