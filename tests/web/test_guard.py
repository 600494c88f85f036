"""Hostile requests: every route of the designer refuses them before an action runs."""

import json
import os
import socket
import time
from http.client import HTTPConnection
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import pytest

from khep_twin.errors import PortError
from khep_twin.web.answers import QUIET_HEADER
from khep_twin.web.documents import Documents
from khep_twin.web.guard import FILE_LIMIT, JSON_LIMIT
from khep_twin.web.routes import Page
from khep_twin.web.server import Server
from tests.web.conftest import HANDSHAKE, Client, run_server

DRAFT: dict[str, Any] = {
    "version": 1,
    "name": "x",
    "arena": {"width_mm": 600, "height_mm": 500},
    "robot": [{"x_mm": 300, "y_mm": 250, "heading_deg": 90}],
}


def routes(tmp_path: Path) -> list[tuple[str, str]]:
    """Method and path of each route; GET with a handshake for the websocket."""
    app = Page(Documents(tmp_path), None).app()
    pairs: list[tuple[str, str]] = []
    for route in app.routes:
        methods = getattr(route, "methods", None)
        path = str(getattr(route, "path", "")).replace("{name}", "designer.js")
        pairs.append(("WS" if methods is None else "POST" if "POST" in methods else "GET", path))
    return pairs


def ask(client: Client, method: str, path: str, headers: dict[str, str], body: bytes | None = None) -> int:
    if method == "WS":
        return client.raw("GET", path, {**headers, **HANDSHAKE})[0]
    return client.raw(
        method, path, headers, body if body is not None else b"{}" if method == "POST" else None
    )[0]


def test_there_are_routes_of_each_kind(tmp_path: Path) -> None:
    pairs = routes(tmp_path)
    assert {method for method, _ in pairs} == {"GET", "POST", "WS"}
    assert len(pairs) > 20


@pytest.mark.parametrize(
    "host",
    [
        "evil.example",
        "127.0.0.1.evil.example:{port}",
        "127.0.0.1",
        "127.0.0.1:{port}@evil",
        "",
        "[::1]:{port}",
    ],
)
def test_another_host_is_refused_on_every_route(client: Client, tmp_path: Path, host: str) -> None:
    port = client.host.rpartition(":")[2]
    for method, path in routes(tmp_path):
        status = ask(client, method, client.base + path, client.headers(Host=host.format(port=port)))
        assert status == 403, (method, path)


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "https://127.0.0.1:1", "http://127.0.0.1"])
def test_another_origin_is_refused_on_every_route(client: Client, tmp_path: Path, origin: str) -> None:
    for method, path in routes(tmp_path):
        assert ask(client, method, client.base + path, client.headers(Origin=origin)) == 403, (method, path)


def test_no_origin_is_refused_but_for_what_is_only_looked_at(client: Client, tmp_path: Path) -> None:
    headers = client.headers()
    del headers["Origin"]
    for method, path in routes(tmp_path):
        if method != "GET":
            assert ask(client, method, client.base + path, headers) == 403, (method, path)


def test_another_site_is_refused_on_every_route(client: Client, tmp_path: Path) -> None:
    for method, path in routes(tmp_path):
        for site in ("cross-site", "same-site"):
            assert ask(client, method, client.base + path, client.headers(Sec_Fetch_Site=site)) == 403, (
                method,
                path,
            )


@pytest.mark.parametrize("token", ["", "/wrong", "/{token}x", "/{short}", "/static", "/é"])
def test_no_token_is_refused_on_every_route(client: Client, tmp_path: Path, token: str) -> None:
    key = client.base.removeprefix("/")
    base = token.format(token=key, short=key[:-1]).encode().decode("latin-1").replace("Ã©", "%C3%A9")
    for method, path in routes(tmp_path):
        assert ask(client, method, base + path, client.headers()) == 403, (method, path)


@pytest.mark.parametrize(
    "way", ["/../../../etc/passwd", "/..%2f..%2fetc/passwd", "/%2e%2e/x", "/..\\x", "//etc/passwd", "/%00"]
)
def test_a_path_out_of_the_folder_is_refused_on_every_route(client: Client, tmp_path: Path, way: str) -> None:
    for method, path in routes(tmp_path):
        assert ask(client, method, client.base + path.rstrip("/") + way, client.headers()) == 403, (
            method,
            path,
        )


@pytest.mark.parametrize(
    "kind", ["application/x-www-form-urlencoded", "multipart/form-data; boundary=x", "text/plain", ""]
)
def test_a_form_is_refused_on_every_route(client: Client, tmp_path: Path, kind: str) -> None:
    for _, path in routes(tmp_path):
        status = ask(client, "POST", client.base + path, client.headers(Content_Type=kind), b"a=b")
        assert status == 403, path


def test_what_is_too_long_is_refused_on_every_route(client: Client, tmp_path: Path) -> None:
    for method, path in routes(tmp_path):
        for kind, limit in (("application/json", JSON_LIMIT), ("application/octet-stream", FILE_LIMIT)):
            headers = client.headers(Content_Type=kind, Content_Length=str(limit + 1))
            # A handshake has no body, so a GET is sent with one.
            plain = "GET" if method == "WS" else method
            assert ask(client, plain, client.base + path, headers, b"") == 413, (method, path)


def test_what_does_not_state_its_length_is_counted(client: Client) -> None:
    head = "\r\n".join(
        f"{name}: {value}" for name, value in client.headers(Transfer_Encoding="chunked").items()
    )
    host, _, port = client.host.rpartition(":")
    with socket.create_connection((host, int(port)), timeout=10) as connection:
        connection.sendall(f"POST {client.base}/do/check HTTP/1.1\r\n{head}\r\n\r\n".encode())
        chunk = b"10000\r\n" + b" " * 0x10000 + b"\r\n"
        try:
            for _ in range(JSON_LIMIT // 0x10000 + 1):
                connection.sendall(chunk)
        except OSError:
            pass  # the server has closed the connection
        assert connection.recv(100).startswith(b"HTTP/1.1 413")


def test_other_methods_are_refused_on_every_route(client: Client, tmp_path: Path) -> None:
    for _, path in routes(tmp_path):
        for method in ("PUT", "DELETE", "OPTIONS", "PATCH", "TRACE"):
            assert client.raw(method, client.base + path, client.headers())[0] == 403, (method, path)


def test_a_header_twice_is_refused(client: Client) -> None:
    host, _, port = client.host.rpartition(":")
    with socket.create_connection((host, int(port)), timeout=10) as connection:
        lines = [f"GET {client.base}/ HTTP/1.1", f"Host: {client.host}", "Origin: http://evil.example"]
        lines += [f"Origin: http://{client.host}", "", ""]
        connection.sendall("\r\n".join(lines).encode())
        assert b" 403 " in connection.recv(100)


@pytest.mark.parametrize("name", ["../x.toml", "/etc/x.toml", "a/../../x.toml", "..\\x.toml", "x\0.toml", ""])
def test_files_outside_the_folder_are_refused(client: Client, name: str) -> None:
    _, hello = client.do("hello")
    if name:
        assert client.do("open", file=name)[0] == 403
        assert client.do("keep", file=name, draft={})[0] == 403
        assert client.do("save", file=name, draft=hello["draft"])[0] == 403
    assert client.do("start", draft={**hello["draft"], "robot": []}, log=name)[0] in (400, 403)


def test_a_link_out_of_the_folder_is_refused(client: Client, tmp_path: Path) -> None:
    outside = tmp_path.parent / f"{tmp_path.name}-outside"
    outside.mkdir()
    (tmp_path / "way").symlink_to(outside)
    assert client.do("save", file="way/x.toml", draft=client.do("hello")[1]["draft"])[0] == 403
    assert not list(outside.iterdir())


def test_the_page_itself_is_answered(client: Client) -> None:
    assert client.raw("GET", client.base + "/", {"Host": client.host, "Sec-Fetch-Site": "none"})[0] == 200
    assert client.do("hello")[0] == 200
    assert client.raw("GET", client.base + "/live", client.headers(**HANDSHAKE))[0] == 101


def test_other_machines_are_let_in_on_demand_only(tmp_path: Path) -> None:
    with pytest.raises(PortError, match="--allow-remote"):
        Server(tmp_path, None, "0.0.0.0:0")


def test_a_server_on_all_addresses_is_reached_by_each_of_them_and_by_no_other_name(tmp_path: Path) -> None:
    with run_server(tmp_path, listen="0.0.0.0:0", allow_remote=True) as client:
        port = client.host.rpartition(":")[2]
        path = client.base + "/"
        assert not client.host.startswith("0.0.0.0")
        for host in (client.host, f"127.0.0.1:{port}", f"localhost:{port}"):
            assert client.raw("GET", path, {"Host": host})[0] == 200
        for host in (f"evil.example:{port}", f"0.0.0.0:{port}", f"198.51.100.7:{port}"):
            assert client.raw("GET", path, {"Host": host})[0] == 403


def test_each_server_has_a_token_of_its_own(tmp_path: Path) -> None:
    servers = [Server(tmp_path, None, "127.0.0.1:0") for _ in range(2)]
    tokens = {server.url.split("/")[3] for server in servers}
    assert len(tokens) == 2
    assert all(len(token) >= 32 for token in tokens)
    for server in servers:
        server.serve(lambda: True)


def test_the_address_that_the_browser_is_given_works_once(tmp_path: Path) -> None:
    lines: list[str] = []
    with run_server(tmp_path, report=lines.append) as client:
        server = client.server
        path = urlsplit(server.one_time_url).path
        headers = {"Host": client.host, "Sec-Fetch-Site": "none"}
        assert server.one_time_url != server.url
        for wrong in ({**headers, "Host": "evil.example"}, {**headers, "Sec-Fetch-Site": "cross-site"}):
            assert client.raw("GET", path, wrong)[0] == 403
        assert client.raw("GET", f"{path}do/list", headers)[0] == 403
        connection = HTTPConnection(client.host, timeout=10)
        connection.request("GET", path, headers=headers)
        answer = connection.getresponse()
        assert (answer.status, answer.headers["Location"]) == (303, urlsplit(server.url).path)
        connection.close()
        assert lines == []
        assert [client.raw("GET", path, headers)[0] for _ in range(3)] == [403] * 3
        assert len(lines) == 1
        assert lines[0].startswith("the address that the browser was given, which works once, was used again")
        assert client.raw("GET", f"{client.base}/", headers)[0] == 200


def test_what_cannot_be_sent_on_is_no_object_and_leaves_no_draft(client: Client, tmp_path: Path) -> None:
    for text in (rb'{"draft": {"name": "\ud800"}}', b'{"draft": {"x": NaN}}', b'{"draft": {"x": 1e999}}'):
        for action in ("check", "keep", "connect", "pace"):
            status, _ = client.raw("POST", f"{client.base}/do/{action}", client.headers(), text)
            assert status == 400, (action, text)
    assert not (tmp_path / ".unnamed.toml.draft").exists()
    (tmp_path / ".unnamed.toml.draft").write_bytes(rb'{"name": "\ud800"}')
    assert client.do("hello")[0] == 200


def test_a_refusal_is_answered_200_where_the_page_asks_so(client: Client) -> None:
    """A browser reports any other status in its console."""
    for action, body in (
        ("open", b'{"file": "none.toml"}'),
        ("open", b'{"file": "../x.toml"}'),
        ("run", b"{}"),
    ):
        for extra, expected in (({}, (400, 403)), ({QUIET_HEADER: "yes"}, (200,))):
            headers = client.headers() | extra
            status, reply = client.raw("POST", f"{client.base}/do/{action}", headers, body)
            assert (status in expected, "error" in json.loads(reply)) == (True, True), (action, extra)


def test_what_is_reported_names_files_from_the_folder_on(client: Client, tmp_path: Path) -> None:
    (tmp_path / "run.mcap").write_bytes(b"no log")
    (tmp_path / "wide.toml").write_bytes(b"\xff\xfe")
    for action, file in (("report", "run.mcap"), ("open", "wide.toml"), ("open", "none.toml")):
        text = client.do(action, file=file)[1]["error"]
        assert (str(tmp_path) in text, file in text) == (False, True), text
    texts: list[str] = []
    page = client.server._page  # pyright: ignore[reportPrivateUsage]
    page._broadcaster.publish = lambda message: texts.append(message.get("text", ""))  # type: ignore[method-assign]
    (tmp_path / "fails.py").write_text("def controller(robot):\n    nonsense()\n")
    assert client.do("start", draft=DRAFT)[0] == 200
    assert client.do("run", controllers=["fails.py"], cycles=1)[0] == 200
    while not any(texts):
        time.sleep(0.01)
    assert "".join(texts).startswith("fails.py:2: NameError")


def test_a_name_that_is_too_long_is_reported(client: Client) -> None:
    for action, values in (
        ("open", {}),
        ("save", {"draft": DRAFT}),
        ("keep", {"draft": DRAFT}),
    ):
        status, reply = client.do(action, file="x" * 300 + ".toml", **values)
        assert (status, "too long" in reply["error"]) == (400, True), action


def test_a_pipe_is_no_file_and_holds_nobody_up(client: Client, tmp_path: Path) -> None:
    for name in ("pipe.toml", "pipe.mcap", ".mine.toml.draft"):
        os.mkfifo(tmp_path / name)
    for action, values in (("open", {}), ("save", {"draft": DRAFT})):
        status, reply = client.do(action, file="pipe.toml", **values)
        assert (status, "no regular file" in reply["error"]) == (400, True), action
    assert "no regular file" in client.do("start", draft=DRAFT, log="pipe.mcap")[1]["error"]
    assert client.do("save", file="mine.toml", draft=DRAFT)[0] == 200
    assert client.do("open", file="mine.toml")[0] == 200


def test_a_draft_that_is_a_link_is_neither_read_nor_written(client: Client, tmp_path: Path) -> None:
    outside = tmp_path.with_name(f"{tmp_path.name}-outside.json")
    outside.write_text('{"name": "outside"}')
    (tmp_path / ".mine.toml.draft").symlink_to(outside)
    assert client.do("keep", file="mine.toml", draft=DRAFT)[0] == 403
    assert Documents(tmp_path).drafts("mine.toml") == []
    assert outside.read_text() == '{"name": "outside"}'
