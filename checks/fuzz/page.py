"""A fuzz target: requests to the designer's page, well formed and not, from its browser and from others.

    python -m checks fuzz-page -runs=1000000      with atheris (libFuzzer)

An input is up to four requests, each a recipe: one of the page's requests, and steps of four bytes that
change its JSON, its head, its path, its lengths or its bytes, or add messages of a websocket. The bytes pass
through the server's connection, guard and routes (`page_in_memory`). `check` states the conditions.
"""

import json
import os
import shutil
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

from checks.fuzz.libfuzzer import fuzz
from checks.fuzz.page_recipes import BASES, HOST, ORIGIN, SECRET, TOKEN, requests_of
from tools.command_table import ROOT

MODULES = ("khep_twin.web", "khep_twin.web.server", "khep_twin.playpen", "khep_twin.files.toml_files")
"""Packages whose branches libFuzzer looks for."""

PLAYPEN = """version = 1
name = "a"
[arena]
width_mm = 600
height_mm = 500
[[robot]]
x_mm = 300
y_mm = 250
heading_deg = 90
[[lamp]]
x_mm = 100
y_mm = 100
power_w = 1.0
"""

WATCHED = {"open", "os.listdir", "os.scandir", "os.remove", "os.rename", "os.mkdir", "os.rmdir", "os.symlink"}
WATCHED |= {"os.link", "os.truncate", "os.chmod", "os.utime", "shutil.rmtree"}
FORBIDDEN = {"os.system", "os.exec", "os.fork", "os.posix_spawn", "subprocess.Popen", "socket.connect"}
FORBIDDEN |= {"socket.bind", "socket.getaddrinfo", "os.symlink", "os.link", "shutil.rmtree", "os.rmdir"}
"""Events of Python's audit that are looked at while a request is answered, and that no request may cause."""


class Touched:
    """Watch on all files that the process opens, lists or changes while a request is answered.

    `registry` is the one folder outside that may be touched.
    """

    def __init__(self, inside: Path) -> None:
        self.findings: list[str] = []
        self._inside = str(inside)
        self.registry = ""
        ours = (Path(sys.prefix), Path(sys.base_prefix), ROOT, Path("/usr"), Path("/sys"))
        self._allowed_roots = tuple(str(path.resolve()) for path in ours)
        self._searched = {os.path.realpath(path) for path in sys.path}  # for modules
        self.on = False
        sys.addaudithook(self._look)

    def _look(self, event: str, words: tuple[Any, ...]) -> None:
        if not self.on or (event not in WATCHED and event not in FORBIDDEN):
            return
        if event in FORBIDDEN:
            self.findings.append(f"{event} {words!r:.200}")
            return
        writes = event not in ("open", "os.listdir", "os.scandir")
        if event == "open":
            writes = bool((words[2] or 0) & (os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC))
        for path in words[: 2 if event == "os.rename" else 1]:
            if isinstance(path, str | bytes | os.PathLike):
                self.on = False  # its access to the path does not count
                place = os.path.realpath(os.fsdecode(path))
                self.on = True
                if not self._allowed(place, writes):
                    self.findings.append(f"{event} {place}")

    def _allowed(self, place: str, writes: bool) -> bool:
        if any(place == folder or place.startswith(folder + "/") for folder in (self._inside, self.registry)):
            return True
        return not writes and (
            place in self._searched
            or place.startswith(self._allowed_roots)
            or place.startswith(("/proc/", "/dev"))
        )


class Place:
    """Folder of the designer, with files, links and a pipe, and a secret beside it."""

    def __init__(self) -> None:
        from checks.fuzz.logs import folder

        self.above = folder() / "page"
        self.root = self.above / "root"
        self.state: dict[str, tuple[int, ...]] = {}
        self.make()

    def make(self) -> None:
        """Replace all files and folders by new ones."""
        shutil.rmtree(self.above, ignore_errors=True)
        for folder in (self.root / "sub", self.above / "outside"):
            folder.mkdir(parents=True)
        for name in ("a.toml", "sub/b.toml", ".hidden.toml"):
            (self.root / name).write_text(PLAYPEN)
        (self.root / "bad.toml").write_bytes(b"version = \xff\n")
        (self.root / "prog.py").write_text("def controller(robot):\n    robot.proximity()\n")
        (self.root / "run.mcap").write_bytes(b"a log")
        (self.root / ".a.toml.T1.draft").write_text(json.dumps({"draft": {"name": "x"}}))
        (self.above / "outside" / "secret.toml").write_text(PLAYPEN.replace('"a"', f'"{SECRET}"'))
        (self.root / "link.toml").symlink_to(self.above / "outside" / "secret.toml")
        (self.root / "linked").symlink_to(self.above / "outside")
        (self.root / ".a.toml.T2.draft").symlink_to(self.above / "outside" / "secret.toml")
        os.mkfifo(self.root / "pipe.toml")
        self.state = self.look()

    def look(self) -> dict[str, tuple[int, ...]]:
        """Return the identifying state of each file."""
        return dict(self._states(str(self.above)))

    def outside(self, states: dict[str, tuple[int, ...]]) -> dict[str, tuple[int, ...]]:
        """Return the states of the files outside the folder."""
        return {path: state for path, state in states.items() if not path.startswith(f"{self.root}/")}

    def _states(self, folder: str) -> Iterator[tuple[str, tuple[int, ...]]]:
        with os.scandir(folder) as entries:
            for entry in entries:
                is_folder = entry.is_dir(follow_symlinks=False)
                is_ours = entry.path in (str(self.root), str(self.root / "sub"))
                stat = entry.stat(follow_symlinks=False)
                # A folder's time changes with a temporary file as well.
                yield (
                    entry.path,
                    (stat.st_mode,) if is_ours else (stat.st_ino, stat.st_size, stat.st_mtime_ns),
                )
                if is_folder:
                    yield from self._states(entry.path)


@cache
def designer() -> tuple[Place, Touched, Any]:
    """Return the folder, the watch on files, and the designer."""
    from checks.fuzz.page_in_memory import Designer

    place = Place()
    designer = Designer(place.root)
    warm = designer.opened()  # imports and caches do not count
    for number in range(len(BASES)):
        for pieces in requests_of(bytes([0, number, 0])):
            warm.say(pieces)
    warm.close()
    place.make()
    return place, Touched(place.root), designer


def check(data: bytes) -> None:
    """Send requests to a new page.

    Raises:
        AssertionError: An answer is no HTTP or above 499, a refusal is not a clear line or has changed a
            file, a stranger's request is accepted, or a file outside the folder is touched or its content
            sent.
    """
    from khep_twin.ports.link import private_folder

    place, touched, designer_ = designer()
    touched.registry = str(private_folder().resolve())  # of running servers, whose ports the page offers
    if place.look() != place.state:
        place.make()
    designer_.errors.records.clear()
    browser = designer_.opened()
    try:
        for pieces in requests_of(data):
            before = place.look()
            touched.on = True
            try:
                sent = browser.say(pieces)
            finally:
                touched.on = False
            check_answers(b"".join(pieces), sent, before != place.look())
            assert place.outside(place.look()) == place.outside(place.state)
            assert not touched.findings, str(touched.findings)
    finally:
        touched.findings.clear()
        browser.close()
    for record in designer_.errors.records:
        raise AssertionError(record.getMessage()) from (record.exc_info or (None, None))[1]


def check_answers(request: bytes, sent: bytes, changed: bool) -> None:
    """Check the answers of one connection, and that refused requests changed no file."""
    from checks.fuzz.page_in_memory import answers

    responses = answers(sent)
    assert SECRET.encode() not in sent, sent[:200]
    is_stranger = (
        TOKEN not in request or HOST not in request or (b"POST" in request[:9] and ORIGIN not in request)
    )
    for status, head, body in responses:
        assert status < 500, (status, body[:300])
        assert not (is_stranger and status < 400), (status, request[:300])
        is_uvicorns = status in (400, 426) and b"application/json" not in head
        is_sockets = status == 101 or b"websocket" in request.lower()
        assert is_uvicorns or is_sockets or b"content-security-policy" in head, head
        if status >= 400 and (body or not (is_sockets or b"HEAD" in request)):
            check_refusal(head, body)
    assert not changed or any(status < 400 for status, _, _ in responses), responses


def check_refusal(head: bytes, body: bytes) -> None:
    """Check that a refusal is one clear line for each problem."""
    if b"application/json" in head:
        error = json.loads(body)["error"]
        assert error, body
        assert all(line.isprintable() and line.strip() for line in error.split("\n")), body
        assert len(error) < 100_000, len(error)
    else:
        text = body.decode("utf-8")
        if text.startswith("Failed to open a WebSocket"):  # in the words of the library websockets
            return
        if text.startswith("1e\r\nInvalid HTTP request received.\r\n"):  # uvicorn's replies, in chunks
            return
        assert text.count("\n") <= 1, body
        assert text.strip().isprintable(), body
        assert text.strip(), body


def seeds(target: Path) -> None:
    """Write seed inputs: each of the page's requests, and each kind of step."""
    for number in range(len(BASES)):
        (target / f"request{number}").write_bytes(bytes([0, number, 0]))
        for kind in range(0, 16, 3):
            step = bytes([kind, 5 * kind + number, kind * number % 256, number])
            (target / f"step{number}-{kind}").write_bytes(bytes([0, number, 1]) + step)


def main() -> None:
    """Run libFuzzer with options of the command line."""
    from checks.fuzz.logs import folder

    folder()
    fuzz(check, seeds, MODULES, "-max_len=120", "-len_control=0", "-rss_limit_mb=2000")
