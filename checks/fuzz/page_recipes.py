"""Requests of the designer's page, and recipes that change them, for a fuzz target."""

import copy
import json
from collections.abc import Iterator
from typing import Any

HOST, TOKEN = b"127.0.0.1:7000", b"Zq3vT0kEn-0f_tHe_pAgE-8hWm2x4LQ"
ORIGIN = b"http://127.0.0.1:7000"

SECRET = "tHe-sEcReT-7f3a91"
"""Text in a file outside the folder."""

DRAFT: dict[str, Any] = {
    "version": 1,
    "name": "x",
    "arena": {"width_mm": 600, "height_mm": 500},
    "robot": [{"x_mm": 300, "y_mm": 250, "heading_deg": 90}],
    "block": [{"x_mm": 100, "y_mm": 100, "width_mm": 40, "length_mm": 40, "height_mm": 40, "movable": True}],
    "lamp": [{"x_mm": 500, "y_mm": 400, "power_w": 1.0}],
}

DRAFT4: dict[str, Any] = {
    "version": 1,
    "name": "four",
    "arena": {"width_mm": 1500, "height_mm": 1200},
    "robot": [{"x_mm": 700, "y_mm": 600, "heading_deg": 90, "model": "khepera4", "rom": "kh4server"}],
}
"""Draft of a playpen with a Khepera IV."""

RUNS = 0x80
"""Bit of the first byte: a twin is started before."""

ACTIONS: dict[str, dict[str, Any]] = {
    "hello": {"tab": "T1", "file": "a.toml"},
    "list": {},
    "open": {"file": "a.toml"},
    "library": {"name": "obstacles"},
    "thumbnail": {"name": "default"},
    "left": {"file": "a.toml"},
    "check": {"draft": DRAFT},
    "save": {"file": "new.toml", "draft": DRAFT, "version": None, "base": {"file": "a.toml"}, "rename": True},
    "keep": {"file": "a.toml", "draft": DRAFT, "version": "x", "base": {"library": "default"}, "page": "T1"},
    "preview": {"draft": DRAFT},
    "scene": {"draft": DRAFT},
    "start": {"draft": DRAFT, "file": "a.toml", "seed": 1, "noise": True, "speed": 0, "paused": True},
    "log": {"file": "run.mcap"},
    "report": {"file": "run.mcap"},
    "page": {"file": "run.mcap"},
    "connect": {"port": "socket://127.0.0.1:9"},
    "program": {"file": "prog.py", "model": "khepera1"},
    "save-program": {"file": "new.py", "text": "def controller(robot): ...", "overwrite": True},
    "pace": {"speed": 2.5, "paused": False},
    "step": {},
    "put": {"robot": 0, "x_mm": 200, "y_mm": 200, "heading_deg": 45},
    "room": {"robot": 0, "x_mm": 100, "y_mm": 100},
    "switch": {"lamp": 0, "on": False},
    "run": {"controllers": ["prog.py"], "runs": 2, "cycles": 5, "pause": 0.1, "folder": "results"},
    "sense": {"what": "light", "motion": "rotational", "amount": 90, "speed": 5, "return": True, "text": "t"},
    "figure": {"sensor": "left 90", "y_min": 0, "grid": True},
    "save-sensed": {"file": "sensed.csv"},
    "challenges": {},
    "challenge-picture": {"name": "stop"},
    "score": {"challenge": "stop", "program": "prog.py"},
    "score-table": {"challenge": "stop", "folder": "sub"},
    "score-csv": {},
    "score-stop": {},
    "stop": {},
    "end": {},
}
"""Requests of each action that the page could send."""

BASES: list[tuple[str, str, Any]] = [
    *(("POST", f"/do/{name}", arguments) for name, arguments in ACTIONS.items()),
    ("POST", "/do/start", {**ACTIONS["start"], "log": "new.mcap"}),
    ("POST", "/do/save", {**ACTIONS["save"], "file": "a.toml", "overwrite": True}),
    *(("POST", f"/do/{name}", {**ACTIONS[name], "draft": DRAFT4}) for name in ("check", "preview", "scene")),
    ("POST", "/do/start", {**ACTIONS["start"], "draft": DRAFT4}),
    ("POST", "/do/library", {"name": "arena4"}),
    ("GET", "/", None),
    ("GET", "/static/model.js", None),
    ("HEAD", "/static/index.html", None),
    ("POST", "/import?name=scan.png&mm=2.5", b"\x89PNG\r\n\x1a\n"),
    ("POST", "/import", b"MATLAB 5.0 MAT-file"),
    ("GET", "/live", "websocket"),
]
"""Method, path, and content: JSON, bytes, or a websocket."""

NAMES = """../outside/secret.toml /etc/passwd link.toml linked/secret.toml linked pipe.toml sub sub/../a.toml
sub/b.toml a.toml .hidden.toml a.toml/x.toml prog.py prog.py:controller sub/.toml a\b.toml ./a.toml run.mcap
%2e%2e/secret.toml bad.toml T2 ../T1 ~/x.toml nowhere/x.toml x.mat x.csv x.mcap . .. / /dev/null socket://
khep://x rfc2217://a:99999 default braitenberg khepera2 khepera4 kh4server arena4 6.05
vision Prox9 black linear"""

ODD: list[Any] = [
    *(None, True, False, 0, -1, 1, 2**31, 2**53 + 1, 2**63, 2**64, 10**400, 0.5, -0.0, 1e-320, 1e308),
    *(float("nan"), float("inf"), float("-inf"), [], {}, [[]], {"": {}}, [None], "", " ", "\0", "\ud800"),
    *("a.toml\0", "a" * 600, "a" * 300 + ".toml", "\u202e.toml", "new\n.toml", "\u00e9.toml", "x" * 9000),
    *([1, 2] * 3, [[0, 0], [1, 1], [0, 1]], ["gripper"], ["gripper", "gripper"], {"a": 1}),
    *NAMES.split(),
]
"""Values that JSON is given."""

TEXTS = [
    *(b"", b"\r\n", b"\0", b"\xff", b"[" * 400, b"9" * 5000, b"\xed\xa0\x80", b" HTTP/1.1", b": ", b"\t"),
    *(b"0\r\n\r\n", *rb"""%2e%2e .. // \ { " , 1e999 NaN \ud800 "a":1,"a":2""".split()),
]
"""Bytes that are put into a request."""

HEADERS = b"""Host Origin Sec-Fetch-Site Content-Type Content-Length Connection Upgrade
    Transfer-Encoding Expect
Range Cookie Sec-WebSocket-Key Sec-WebSocket-Version Sec-WebSocket-Extensions Sec-WebSocket-Protocol
If-None-Match If-Range X""".split()

VALUES = [
    *b"""127.0.0.1:7000 localhost:7000 evil.example 127.0.0.1 [::1]:7000 null none http://127.0.0.1:7000
    http://evil.example https://127.0.0.1:7000 http://127.0.0.1:7000.evil cross-site same-site same-origin
    application/json application/octet-stream text/plain multipart/form-data 0 1 -1 +5 99999999 3000000 1e3
    chunked 100-continue Upgrade close websocket 13 8 h2c bytes=0-1 bytes=5-1,0-0 bytes=-999999
    bytes=99999999- permessage-deflate * AAAAAAAAAAAAAAAAAAAAAA==""".split(),
    *(b"", b"1, 1", b"\xb2", b"\x80", b"gzip, chunked", b"keep-alive, Upgrade", b"a\tb", b"x" * 40000),
    b"application/json; charset=utf-8",
]
"""Values that headers are given."""

SOCKET_KEY = b"AAAAAAAAAAAAAAAAAAAAAA=="

PATHS = [
    *rb"""/.. /../ %2e%2e/ // \ /%00 ? ?name=%ff&mm=nan ?mm=1e999 #x /do/open /static/.. /static/%2e /static/
    ;x /do/nothing ?mm=0x1""".split(),
    *(b"\xc3\xa9", b"?name=" + b"a" * 9000),
]

ODD_KEYS = ["", "\0"]
ODD_KEYS += """file draft tab robot lamp block cylinder stripe x spots turrets page overwrite
__class__ model_config
outline_mm name surface lighting radio""".split()
"""Keys that JSON is given."""

METHODS = b"GET POST HEAD PUT OPTIONS TRACE CONNECT PATCH get BREW".split()


class Request:
    """Request to be changed: method, path, headers, and content."""

    def __init__(self, number: int) -> None:
        method, path, content = BASES[number % len(BASES)]
        self.method, self.path = method.encode(), b"/" + TOKEN + path.encode()
        self.content = copy.deepcopy(content)
        self.headers = [(b"Host", HOST), (b"Origin", ORIGIN), (b"Sec-Fetch-Site", b"same-origin")]
        self.edits: list[tuple[int, int, int]] = []
        self.frames = b""
        self.size: bytes | None = None
        self.chunked = False
        if content == "websocket":
            self.headers += [(b"Connection", b"Upgrade"), (b"Upgrade", b"websocket")]
            self.headers += [(b"Sec-WebSocket-Version", b"13"), (b"Sec-WebSocket-Key", SOCKET_KEY)]
            self.frames = frame(1, b'{"file": "a.toml"}')
        elif content is not None:
            kind = b"octet-stream" if isinstance(content, bytes) else b"json"
            self.headers += [(b"Content-Type", b"application/" + kind)]

    def change(self, kind: int, a: int, b: int, c: int) -> None:
        """Take one step."""
        header = HEADERS[a % len(HEADERS)]
        rest = [pair for pair in self.headers if pair[0] != header]
        match kind % 16:
            case 0 | 1 | 2 | 3 | 4 if isinstance(self.content, dict):
                self._change_json(self.content, kind % 16, a, b, c)
            case 5:
                self.headers = [*rest, (header, VALUES[b % len(VALUES)])]
            case 6:
                self.headers = rest
            case 7:
                self.headers.append((header, VALUES[b % len(VALUES)]))
            case 8:
                self.path = self.path + PATHS[a % len(PATHS)]
            case 9:
                place = a % (len(self.path) + 1)
                self.path = self.path[:place] + TEXTS[b % len(TEXTS)] + self.path[place + c % 3 :]
            case 10:
                self.method = METHODS[a % len(METHODS)]
            case 11:
                self.size = (b"%d" % (256 * a + b), VALUES[b % len(VALUES)])[c % 2]
            case 12:
                self.chunked = True
            case 13:
                payload = TEXTS[b % len(TEXTS)] + bytes(c) * (1 + a)
                self.frames += frame(a, payload, masked=b < 250, size=b % 4)
            case _:
                self.edits.append((256 * a + b, kind, c))

    def _change_json(self, content: dict[str, Any], kind: int, a: int, b: int, c: int) -> None:
        places = list(places_in(content))
        if not places:
            content[ODD_KEYS[b % len(ODD_KEYS)]] = ODD[c % len(ODD)]
            return
        holder, key = places[a % len(places)]
        match kind:
            case 0 | 1:
                holder[key] = copy.deepcopy(ODD[b % len(ODD)])
            case 2:
                del holder[key]
            case 3 if isinstance(holder, dict):
                holder[ODD_KEYS[b % len(ODD_KEYS)]] = copy.deepcopy(ODD[c % len(ODD)])
            case 4 if isinstance(holder, list):
                holder.extend(copy.deepcopy(holder[:40]) * (1 + b % 3))
            case _ if isinstance(holder[key], int | float):
                holder[key] = (b - 128) * (1, 10, 0.1, 1000)[c % 4]
            case _:
                holder[key] = [copy.deepcopy(holder[key])]

    def pieces(self, size: int) -> list[bytes]:
        """Return the bytes of the request, in pieces of a size; 0 for one piece."""
        body = self.content if isinstance(self.content, bytes) else b""
        if isinstance(self.content, dict):
            # Python's JSON has NaN and half characters, which hosts may send.
            body = json.dumps(self.content).encode()
        headers = list(self.headers)
        if self.chunked:
            headers.append((b"Transfer-Encoding", b"chunked"))
            body = b"%x\r\n%s\r\n0\r\n\r\n" % (len(body), body)
        elif self.size is not None or self.method == b"POST":
            headers.append((b"Content-Length", b"%d" % len(body) if self.size is None else self.size))
        head = b"".join(b"%s: %s\r\n" % pair for pair in headers)
        data = b"%s %s HTTP/1.1\r\n%s\r\n%s" % (self.method, self.path, head, body)
        for place, kind, value in self.edits:
            place %= len(data) + 1
            odd = TEXTS[value % len(TEXTS)] if kind % 2 else bytes([value])
            data = data[:place] + odd + data[place + kind // 16 % 3 :]
        chunks = [data, self.frames] if self.frames else [data]
        if not size:
            return chunks
        return [
            data_chunk[at : at + size]
            for data_chunk in chunks
            for at in range(0, len(data_chunk), max(size, len(data_chunk) // 50))
        ]


def places_in(content: Any) -> Iterator[tuple[Any, Any]]:
    """Yield each place of a value in JSON: its holder, and its key or index."""
    keys = list(content) if isinstance(content, dict) else range(len(content))
    for key in keys:
        yield content, key
        if isinstance(content[key], dict | list):
            yield from places_in(content[key])


def frame(first: int, payload: bytes, masked: bool = True, size: int = 0) -> bytes:
    """Return a frame of a websocket; a size of 1 to 3 states a wrong length."""
    length = len(payload) + (0, 1, 300, 70_000)[size]
    first = first if first > 15 else 0x80 | first
    if length < 126:
        head = bytes([first, 0x80 * masked | length])
    elif length < 65536:
        head = bytes([first, 0x80 * masked | 126]) + length.to_bytes(2, "big")
    else:
        head = bytes([first, 0x80 * masked | 127]) + length.to_bytes(8, "big")
    return head + bytes(4 * masked) + payload


def requests_of(data: bytes) -> Iterator[list[bytes]]:
    """Yield the pieces of each request of an input."""
    rest = iter(data)
    choice = next(rest, 0)
    if choice & RUNS:
        yield Request(list(ACTIONS).index("start")).pieces(0)
    for _ in range(1 + choice % 4):
        request, choice = Request(next(rest, 0)), next(rest, 0)
        for _ in range(choice % 8):
            request.change(*(next(rest, 0) for _ in range(4)))
        yield request.pieces(choice // 8)
