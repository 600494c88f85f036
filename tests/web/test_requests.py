"""Requests that make no sense: each is answered by a line, and none ends in an error of the server."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.typing import Origin

from khep_twin.web.documents import Documents
from khep_twin.web.requests import RequestError, request_of
from khep_twin.web.routes import Page
from khep_twin.web.server import MESSAGE_LIMIT
from tests.web.conftest import Asker
from tests.web.test_guard import DRAFT

ACTIONS = Page(Documents(Path()), None).actions

VALID: dict[str, Any] = {
    "amount": 15,
    "challenge": "nowhere",
    "draft": {**DRAFT, "lamp": [{"x_mm": 100, "y_mm": 100, "power_w": 7}]},
    "file": "mine.toml",
    "heading_deg": 90,
    "lamp": 0,
    "name": "default",
    "on": True,
    "port": "socket://127.0.0.1:1",
    "robot": 0,
    "text": "",
    "x_mm": 300,
    "y_mm": 250,
}
"""A value of each key that some action needs."""

NEVER = [
    "1" + "0" * 400,
    "1" + "0" * 5000,
    "-1e999",
    "NaN",
    "-Infinity",
    "[" * 40 + "]" * 40,
    '"\\ud800"',
    '{"x": ' * 500 + "1" + "}" * 500,
    '"' + "x" * 100_000 + '"',
]
"""What no key takes, as JSON or what Python takes for it."""

SELDOM = [
    "null",
    "true",
    "0",
    "-1",
    "1.5",
    "1e300",
    str(2**63),
    '""',
    '"\\u0000"',
    '"../x.toml"',
    "[]",
    "[[[]]]",
    "{}",
    '{"\\n": 1}',
]
"""What few keys take."""


def asked(action: str, key: str = "", value: str = "null") -> bytes:
    """An action's request with its needed keys, and one key more, or with another value, as JSON."""
    kind = ACTIONS[action][0]
    needed = {(field.alias or name): field.is_required() for name, field in kind.model_fields.items()}
    texts = {name: json.dumps(VALID[name]) for name, is_needed in needed.items() if is_needed}
    if key:
        texts[key] = value
    return ("{" + ", ".join(f"{json.dumps(name)}: {text}" for name, text in texts.items()) + "}").encode()


def keys(action: str) -> list[str]:
    """Its own keys, and of the first one also those that all have."""
    own = [name for name in ACTIONS[action][0].model_fields if name != "tab" or action == "hello"]
    return [ACTIONS[action][0].model_fields[name].alias or name for name in own]


def answer(asker: Asker, action: str, body: bytes) -> tuple[int, str]:
    """The status, and the line that is told."""
    status, answer = asker.raw("POST", f"{asker.base}/do/{action}", asker.own(), body)
    told = json.loads(answer)["error"] if status != 200 else ""
    # A draft has a line for each of its problems.
    assert all(line.isprintable() and len(line) < 400 for line in told.split("\n")), (action, body[:200])
    return status, told


@pytest.fixture
def twin(asker: Asker, monkeypatch: pytest.MonkeyPatch) -> Iterator[Asker]:
    """A server with a twin that stands still; pictures are not made."""
    monkeypatch.setattr("khep_twin.web.file_actions.render", lambda playpen, path: b"")
    assert asker.do("start", draft=VALID["draft"], paused=True)[0] == 200
    yield asker
    asker.do("end")


def test_what_no_key_takes_is_refused_by_a_line_that_names_the_key(asker: Asker) -> None:
    for action in ACTIONS:
        kind = ACTIONS[action][0]
        for key in keys(action):
            status, told = answer(asker, action, asked(action, key, NEVER[0]))
            assert (status, told.startswith(f"{action}: {key}")) == (400, True), told
            for value in NEVER:
                with pytest.raises(RequestError) as caught:
                    request_of(asked(action, key, value), kind, action)
                told = str(caught.value)
                assert told.startswith((f"{action}: {key}", "nested too deeply")), told
                assert any(word in told for word in ("expected", "choices")), told


def test_any_value_of_any_key_is_answered(twin: Asker) -> None:
    for action in ACTIONS:
        for key in keys(action):
            for value in SELDOM:
                status, _ = answer(twin, action, asked(action, key, value))
                assert 200 <= status < 500, (action, key, value)
    assert twin.do("hello")[0] == 200


@pytest.mark.parametrize("key", ["no_such_key", "\n", "__class__", "x" * 1000])
def test_keys_that_there_are_not_are_refused(asker: Asker, key: str) -> None:
    for action in ACTIONS:
        assert answer(asker, action, asked(action, key))[0] == 400, action


def test_what_is_no_object_is_refused(asker: Asker) -> None:
    for action in ACTIONS:
        for body in (b"", b"null", b"[]", b"1", b'"x"', b"{", b"\xff\xfe", b"{}{}", b'{"tab": "\xc3"}'):
            status, told = answer(asker, action, body)
            assert (status, "JSON" in told) == (400, True), (action, body)


@pytest.mark.parametrize("key", ["x_mm", "width_mm", "seed"])
def test_a_number_of_400_digits_in_a_draft_is_reported_with_its_place(asker: Asker, key: str) -> None:
    huge = 10**400
    draft = {**DRAFT, "block": [{"x_mm": huge}], "arena": {"height_mm": 500, "width_mm": huge}}
    if key == "seed":
        status, told = asker.do("start", draft=DRAFT, seed=huge)
        assert (status, told["error"][:15]) == (400, "start: seed = 1")
        return
    status, told = asker.do("check", draft=draft)
    assert status == 200
    assert any(
        key in problem["text"] and "expected a number" in problem["text"] for problem in told["problems"]
    )


@pytest.mark.parametrize("scale", ["1e400", "nan", "-1", "", "x" * 5000, "1" * 5000])
def test_a_scale_that_is_none_is_refused(asker: Asker, scale: str) -> None:
    headers = asker.own(Content_Type="application/octet-stream")
    status, body = asker.raw("POST", f"{asker.base}/import?mm={scale}&name=x.png", headers, b"\x89PNG")
    told = json.loads(body)["error"]
    assert (status, "expected 0.001 to 1000" in told, len(told) < 200) == (400, True, True)


@pytest.mark.parametrize("said", ["x" * 60_000, "\0", b"\xff", b"", "x" * 70_000])
def test_a_page_may_say_anything_or_is_cut_off_and_the_others_go_on(asker: Asker, said: str | bytes) -> None:
    url, origin = f"ws://{asker.host}{asker.base}/live", Origin(f"http://{asker.host}")
    with connect(url, origin=origin) as page, connect(url, origin=origin) as other:
        page.send(said)
        if not isinstance(said, str) or len(said) > MESSAGE_LIMIT:
            with pytest.raises(ConnectionClosed):
                page.recv(timeout=30)
        assert other.ping().wait(30)
    assert asker.do("hello")[0] == 200
