"""Invalid requests: each is answered by a line, and none causes an error of the server."""

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
from tests.web.conftest import Client
from tests.web.test_guard import DRAFT

ACTIONS = Page(Documents(Path()), None).actions

VALID: dict[str, Any] = {
    "amount": 15,
    "challenge": "nowhere",
    "draft": {**DRAFT, "lamp": [{"x_mm": 100, "y_mm": 100, "power_w": 7}]},
    "file": "mine.toml",
    "model": "khepera1",
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
"""Value of each required key."""

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
"""Values that no key accepts, as JSON or as Python reads it."""

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
"""Values that few keys accept."""


def request_body(action: str, key: str = "", value: str = "null") -> bytes:
    """Return an action's request with the required keys, with one key added or changed, as JSON."""
    kind = ACTIONS[action][0]
    needed = {(field.alias or name): field.is_required() for name, field in kind.model_fields.items()}
    texts = {name: json.dumps(VALID[name]) for name, is_needed in needed.items() if is_needed}
    if key:
        texts[key] = value
    return ("{" + ", ".join(f"{json.dumps(name)}: {text}" for name, text in texts.items()) + "}").encode()


def keys(action: str) -> list[str]:
    """Return an action's keys; `tab`, which all have, only for hello."""
    names = [name for name in ACTIONS[action][0].model_fields if name != "tab" or action == "hello"]
    return [ACTIONS[action][0].model_fields[name].alias or name for name in names]


def answer(client: Client, action: str, body: bytes) -> tuple[int, str]:
    """Return the status, and the text of an error."""
    status, answer = client.raw("POST", f"{client.base}/do/{action}", client.headers(), body)
    text = json.loads(answer)["error"] if status != 200 else ""
    # A draft has a line for each of its problems.
    assert all(line.isprintable() and len(line) < 400 for line in text.split("\n")), (action, body[:200])
    return status, text


@pytest.fixture
def twin(client: Client, monkeypatch: pytest.MonkeyPatch) -> Iterator[Client]:
    """A server with a paced twin that is paused; pictures are not rendered."""
    monkeypatch.setattr("khep_twin.web.file_actions.render", lambda playpen, path: b"")
    assert client.do("start", draft=VALID["draft"], paused=True)[0] == 200
    yield client
    client.do("end")


def test_what_no_key_takes_is_refused_by_a_line_that_names_the_key(client: Client) -> None:
    for action in ACTIONS:
        kind = ACTIONS[action][0]
        for key in keys(action):
            status, text = answer(client, action, request_body(action, key, NEVER[0]))
            assert (status, text.startswith(f"{action}: {key}")) == (400, True), text
            for value in NEVER:
                with pytest.raises(RequestError) as caught:
                    request_of(request_body(action, key, value), kind, action)
                text = str(caught.value)
                assert text.startswith((f"{action}: {key}", "nested too deeply")), text
                assert any(word in text for word in ("expected", "choices")), text


@pytest.mark.long
def test_any_value_of_any_key_is_answered(twin: Client) -> None:
    for action in ACTIONS:
        for key in keys(action):
            for value in SELDOM:
                status, _ = answer(twin, action, request_body(action, key, value))
                assert 200 <= status < 500, (action, key, value)
    assert twin.do("hello")[0] == 200


@pytest.mark.parametrize("key", ["no_such_key", "\n", "__class__", "x" * 1000])
def test_keys_that_there_are_not_are_refused(client: Client, key: str) -> None:
    for action in ACTIONS:
        assert answer(client, action, request_body(action, key))[0] == 400, action


def test_what_is_no_object_is_refused(client: Client) -> None:
    for action in ACTIONS:
        for body in (b"", b"null", b"[]", b"1", b'"x"', b"{", b"\xff\xfe", b"{}{}", b'{"tab": "\xc3"}'):
            status, text = answer(client, action, body)
            assert (status, "JSON" in text) == (400, True), (action, body)


@pytest.mark.parametrize("key", ["x_mm", "width_mm", "seed"])
def test_a_number_of_400_digits_in_a_draft_is_reported_with_its_place(client: Client, key: str) -> None:
    huge = 10**400
    draft = {**DRAFT, "block": [{"x_mm": huge}], "arena": {"height_mm": 500, "width_mm": huge}}
    if key == "seed":
        status, reply = client.do("start", draft=DRAFT, seed=huge)
        assert (status, reply["error"][:15]) == (400, "start: seed = 1")
        return
    status, reply = client.do("check", draft=draft)
    assert status == 200
    assert any(
        key in problem["text"] and "expected a number" in problem["text"] for problem in reply["problems"]
    )


@pytest.mark.parametrize("scale", ["1e400", "nan", "-1", "", "x" * 5000, "1" * 5000])
def test_a_scale_that_is_none_is_refused(client: Client, scale: str) -> None:
    headers = client.headers(Content_Type="application/octet-stream")
    status, body = client.raw("POST", f"{client.base}/import?mm={scale}&name=x.png", headers, b"\x89PNG")
    text = json.loads(body)["error"]
    assert (status, "expected 0.001 to 1000" in text, len(text) < 200) == (400, True, True)


@pytest.mark.parametrize("text", ["x" * 60_000, "\0", b"\xff", b"", "x" * 70_000])
def test_a_page_may_say_anything_or_is_cut_off_and_the_others_go_on(
    client: Client, text: str | bytes
) -> None:
    url, origin = f"ws://{client.host}{client.base}/live", Origin(f"http://{client.host}")
    with connect(url, origin=origin) as page, connect(url, origin=origin) as other:
        page.send(text)
        if not isinstance(text, str) or len(text) > MESSAGE_LIMIT:
            with pytest.raises(ConnectionClosed):
                page.recv(timeout=30)
        assert other.ping().wait(30)
    assert client.do("hello")[0] == 200
