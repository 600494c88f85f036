"""Scenario of the designer's page: browsers that edit, save and drive, and a designer that is killed.

Each browser follows assets/web/main.js: it keeps a draft after each edit, saves with the version that it
knows, and asks its user at a conflict. Another program changes files meanwhile.
"""

import copy
import json
import os
import pathlib
from pathlib import Path
from typing import Any
from unittest.mock import patch

from checks.simulate.compiled_worlds import compiled_worlds
from checks.simulate.designer import Designer, PageRequest, Socket, UnreachedError, installed
from checks.simulate.kernel import NS_PER_S, OpenFile
from checks.simulate.kernel_files import WritesThroughKernel
from checks.simulate.ledger import Ledger, Sent, as_json
from checks.simulate.page_mutants import MUTANTS as MUTANTS
from checks.simulate.page_threads import Threading
from checks.simulate.simulation import Simulation
from khep_twin.drawing import render  # noqa: F401 - before a simulation
from khep_twin.web import drafts

N_BROWSERS = 3

MOST_FULL = 0.1
"""Highest probability that a write finds no room; pages write little, and a designer continues after it."""

NAMES = "first.toml", "second.toml", "third.toml"

REPLY_TIMEOUT_S = 60.0
"""Time within which a request must be answered [s] (assumed)."""


def pages(simulation: Simulation, seconds: float) -> None:
    """Run the designer and its pages for so many seconds."""
    Threading(simulation).install(simulation.system.modules["threading"])
    office = Office(simulation)
    try:
        office.run(seconds)
    finally:
        if office.designer is not None:
            office.designer.loop.close()


class Office:
    """Designer, the pages of its user, and another program.

    Attributes:
        designer: Present start of the designer.
        ledger: Ledger of the work.
        folder: Folder of the files.
    """

    def __init__(self, simulation: Simulation) -> None:
        self.simulation = simulation
        self.folder = simulation.folder / "playpens"
        self._private = simulation.folder / "private"
        for folder in (self.folder, self._private):
            folder.mkdir()
        self.ledger = Ledger(simulation, self.folder)
        self._rng = simulation.rng("office")
        self._descriptors = len(os.listdir("/proc/self/fd"))
        self._n_starts = 0
        self._left_by_kills: set[str] = set()
        self._unique = 0
        self.changed = OpenFile(simulation.kernel)
        self.designer: Designer | None = None
        self._ended_ns: int | None = None

    def run(self, seconds: float) -> None:
        """Run everything."""
        simulation, system = self.simulation, self.simulation.system.modules["os"]
        replaced = system.replace

        def replace(source: Any, target: Any, **options: Any) -> None:
            replaced(source, target, **options)
            self._stamp(Path(target))

        system.replace = replace
        with (
            compiled_worlds(),
            installed(simulation, self._present, self._private),
            patch.object(pathlib, "io", WritesThroughKernel(simulation, MOST_FULL)),
        ):
            simulation.spawn("user", self._keep_running)
            simulation.spawn("editor", self._edit)
            for number in range(N_BROWSERS):
                simulation.spawn(f"browser {number}", Browser(self, number).live)
            simulation.run(seconds)
            if self.designer is not None:
                self.designer.group.kill()
            self._check()
            if (n_descriptors := len(os.listdir("/proc/self/fd"))) != self._descriptors:
                simulation.violate(
                    "leftovers", f"{n_descriptors - self._descriptors} descriptors are left open"
                )

    def unique(self) -> int:
        """Return a number that was not there before."""
        self._unique += 1
        return self._unique

    def pause(self, shortest: float, longest: float) -> None:
        """Let time pass for the present process."""
        kernel = self.simulation.kernel
        until_ns = kernel.now_ns + round(self._rng.uniform(shortest, longest) * NS_PER_S)
        kernel.wait([], lambda: False, until_ns)

    def _present(self) -> Designer:
        assert self.designer is not None
        return self.designer

    def _stamp(self, path: Path) -> None:
        """Give a file the simulated time, and note its content."""
        kernel = self.simulation.kernel
        if path.parent != self.folder:
            return
        now_ns = self.simulation.system.modules["time"].time_ns()
        os.utime(path, ns=(now_ns, now_ns))
        if path.suffix == ".toml":
            group = getattr(kernel.current, "group", None)
            self.ledger.note_write(path, None if group is None else group.requests.get(kernel.current))

    def _keep_running(self) -> None:
        """Start the designer, and again whenever it is gone; look after it meanwhile."""
        while True:
            if self.designer is None or not self.designer.group.alive:
                self._check()
                self._left_by_kills |= self._parts()
                self._n_starts += 1
                self.simulation.count("starts")
                self.designer = Designer(self.simulation, self.folder, self._n_starts)
            self.pause(0.5, 3)
            self._look()

    def _look(self) -> None:
        """Check the designer's errors, and that nothing is left of a twin that has ended."""
        designer = self._present()
        if designer.loop.trouble is not None:
            self.simulation.violate("errors", f"the designer failed: {designer.loop.trouble!r}")
        parts = sorted(self._parts() - self._left_by_kills)
        if parts and not designer.group.requests and designer.alive:
            self.simulation.violate("leftovers", f"no request is carried out, and {parts[0]} is there")
        stages = [thread for thread in designer.group.threads if " stage " in thread.name]
        notes = sorted(self._private.iterdir())
        ended = (
            designer.page is not None
            and designer.page._session._actor is None
            and not designer.group.requests
        )
        if not ended or not (stages or notes) or not designer.alive:
            self._ended_ns = None
        elif self._ended_ns is None:
            self._ended_ns = self.simulation.kernel.now_ns
        elif self.simulation.kernel.now_ns - self._ended_ns > 20 * NS_PER_S and stages:
            self.simulation.violate("leftovers", "a twin still runs, long after its end was acknowledged")

    def _parts(self) -> set[str]:
        """Return the names of unfinished files."""
        return {path.name for path in self.folder.glob(".*.part*")}

    def _check(self) -> None:
        self.ledger.check()

    def _edit(self) -> None:
        """Change files as another program does."""
        faults, kernel = self.simulation.faults, self.simulation.kernel
        while True:
            self.pause(1, 10)
            if not faults.happens("edited", "editor", 0.5):
                continue
            rng = faults.drawn("edited", "editor")
            path = self.folder / rng.choice(NAMES)
            text = drafts.BLANK.format(name=f"edited-{self.unique()}")
            kernel.called()
            _write(path, text)
            self._stamp(path)
            self.simulation.count("edits of others")


class Browser:
    """A page in a browser, and the user before it."""

    def __init__(self, office: Office, number: int) -> None:
        self._office, self._number = office, number
        self._simulation = office.simulation
        self._rng = office.simulation.rng("browser", number)
        self._faults = office.simulation.faults
        self._n_loads = 0
        self._file: str | None = None

    def live(self) -> None:
        """Load the page again and again."""
        self._office.pause(0, 3)
        again = False
        while True:
            designer = self._office.designer
            if designer is None or not designer.alive:
                self._office.pause(0.2, 2)
                again = False  # the page of another start is a new one
                continue
            self._n_loads += 1
            self._tab = f"{self._number}-{self._n_loads}"
            self._designer, self._socket = designer, Socket()
            try:
                self._use(again)
                again = True
            except UnreachedError:
                # As the page is closed, or loaded again, by its user.
                self._office.pause(0, 2)
                again = self._rng.random() < 0.7
            designer.say(self._socket, {"type": "websocket.disconnect", "code": 1001})

    def _use(self, again: bool) -> None:
        """Open the page, and work on it for a while."""
        answer = self._post("hello", {"file": self._file} if again else {})
        self._socket = self._designer.connect()
        self._show(answer, {"file": answer["file"]} if answer["version"] else {})
        self._offer(answer["left"])
        for _ in range(self._rng.randrange(3, 40)):
            self._office.pause(0.05, 4)
            if self._faults.happens("page-left", "pages", 0.2):
                return
            self._read_messages()
            acts = [self._edit] * 8 + [self._save] * 3 + [self._undo, self._save_as, self._open, self._odd]
            acts += [self._drive, self._ask]
            self._rng.choice(acts)()

    def _show(self, answer: dict[str, Any], base: dict[str, str]) -> None:
        self._file, self._version, self._base = answer["file"], answer["version"], base
        self._draft: dict[str, Any] = answer["draft"]
        self._saved = as_json(self._draft)
        self._undone: list[dict[str, Any]] = []
        self._has_draft = False

    @property
    def _changed(self) -> bool:
        return as_json(self._draft) != self._saved

    # Requests ------------------------------------------------------------------------------------------

    def _post(self, action: str, arguments: dict[str, Any]) -> Any:
        """Send a request and return its answer; None if it is refused.

        Raises:
            UnreachedError: The designer, or the page, is gone.
        """
        request = self._ask_once(action, arguments)
        if self._faults.happens("twice", "pages", 0.05) and action not in ("save", "start"):
            request = self._ask_once(action, arguments)
        return self._read(request)

    def _ask_once(self, action: str, arguments: dict[str, Any]) -> PageRequest:
        sent_arguments = {**arguments, "tab": self._tab}
        request = PageRequest(self._simulation, action, copy.deepcopy(sent_arguments))
        timeout_s = REPLY_TIMEOUT_S
        if self._faults.happens("page-left-amid", "pages", 0.05):
            timeout_s = self._faults.drawn("page-left-amid", "pages").uniform(0, 0.01)
        before_ns = self._simulation.kernel.now_ns
        try:
            self._designer.ask(request, json.dumps(sent_arguments).encode(), {}, timeout_s)
        except UnreachedError:
            if self._simulation.kernel.now_ns - before_ns > 0.9 * REPLY_TIMEOUT_S * NS_PER_S:
                self._simulation.violate("errors", f"{action} was not answered in {REPLY_TIMEOUT_S:g} s")
            raise
        return request

    def _read(self, request: PageRequest) -> Any:
        """Return an answer; check that a refusal has its line."""
        self._simulation.count("requests")
        if request.status == 200:
            return json.loads(request.body)
        self._simulation.count("refusals")
        text = request.body.decode()
        line = json.loads(text)["error"] if text.startswith("{") else text.strip()
        if (
            request.status >= 500
            or not line
            or not all(text_line.isprintable() for text_line in line.split("\n"))
        ):
            self._simulation.violate("errors", f"{request.action} was answered {request.status}: {line!r}")
        self._line = line
        return {"conflict": True} if request.status == 409 else None

    # Work of the user ----------------------------------------------------------------------------------

    def _edit(self) -> None:
        """Change the drawing, and keep it."""
        self._undone.append(copy.deepcopy(self._draft))
        number = self._office.unique()
        x_mm = -50.0 if self._rng.random() < 0.1 else 100 + number / 100
        self._draft["robot"] = [{"x_mm": x_mm, "y_mm": 200.0, "heading_deg": 0.0}]
        self._keep()

    def _undo(self) -> None:
        if self._undone:
            self._draft = self._undone.pop()
            self._keep()

    def _keep(self) -> bool:
        """Keep the draft, or delete it if nothing is changed."""
        if not self._changed and not self._has_draft:
            return False
        self._has_draft = changed = self._changed
        draft = as_json(self._draft) if changed else None
        place = self._file, self._tab
        ledger = self._office.ledger
        sent = ledger.sent(place, self._tab, draft)
        answer = self._post(
            "keep",
            {
                "file": self._file,
                "version": self._version,
                "base": self._base,
                "draft": self._draft if changed else None,
            },
        )
        if answer is None:
            return False
        ledger.answered(place, sent)
        ledger.check()
        self._simulation.count("edits")
        return True

    def _forget(self, file: str | None, page: str | None = None) -> None:
        """Delete a draft: the page's, or one that another page has left."""
        place, ledger = (file, self._tab if page is None else page), self._office.ledger
        sent = ledger.sent(place, self._tab, None) if place in ledger.works else None
        arguments = {"file": file, "draft": None} | ({} if page is None else {"page": page})
        if self._post("keep", arguments) is not None and sent is not None:
            ledger.answered(place, sent)

    def _offer(self, left: list[dict[str, Any]]) -> None:
        """Decide on the newest of the drafts that other pages have left."""
        others = [
            offer
            for offer in left
            if offer["page"] != self._tab and as_json(offer["draft"]) != as_json(self._draft)
        ]
        self._check_offered(left)
        if not others or self._rng.random() < 0.3:
            return
        offer = others[0]
        if self._rng.random() < 0.2:
            self._forget(self._file, offer["page"])
            return
        self._version = offer.get("version", self._version)
        self._base = offer.get("base") or self._base
        self._draft = offer["draft"]
        if self._keep():
            self._forget(self._file, offer["page"])

    def _check_offered(self, left: list[dict[str, Any]]) -> None:
        """Check that the newest is offered first."""
        times = [offer["time"] for offer in left]
        if times != sorted(times, reverse=True):
            self._simulation.violate("work", "an older draft is offered before a newer one")

    def _save(self, name: str | None = None, overwrite: bool = False) -> None:
        """Save; at a conflict follow the user's choice."""
        name = name or self._file or self._rng.choice(NAMES)
        before, draft = self._file, copy.deepcopy(self._draft)
        version = self._version if name == before else None
        place = before, self._tab
        arguments = {"file": name, "draft": draft, "version": version, "base": self._base}
        arguments |= {"overwrite": overwrite, "rename": False, "tab": self._tab}
        if self._faults.happens("second-window", "pages", 0.3):
            self._save_elsewhere(arguments)
        request = self._ask_once("save", arguments)
        answer = self._read(request)
        if answer is None:
            return
        if answer.get("conflict"):
            self._simulation.count("conflicts")
            choice = self._rng.randrange(4)
            if choice == 0:
                self._save(name, True)
            elif choice == 1:
                self._save(f"other-{self._office.unique() % 5}.toml")
            elif choice == 2:
                self._load(name)
            return
        self._office.ledger.check_saved(request, answer["version"])
        self._simulation.count("saves")
        if place in self._office.ledger.works:
            self._office.ledger.answered(place, Sent(self._tab, None))
        if name != before:
            self._forget(before)
        self._has_draft = False
        self._file, self._version, self._base = name, answer["version"], {"file": name}
        self._saved = as_json(draft)

    def _save_elsewhere(self, arguments: dict[str, Any]) -> None:
        """Save other changes of the same version in a second window, at the same time."""
        tab = f"{self._tab}-second-{self._office.unique()}"
        robot = {"x_mm": 100 + self._office.unique() / 100, "y_mm": 150.0, "heading_deg": 0.0}
        arguments = {
            **arguments,
            "draft": {**arguments["draft"], "robot": [robot]},
            "tab": tab,
            "overwrite": False,
        }
        request = PageRequest(self._simulation, "save", arguments)
        designer = self._designer

        def save() -> None:
            try:
                designer.ask(request, json.dumps(arguments).encode(), {}, REPLY_TIMEOUT_S)
            except UnreachedError:
                return
            if answer := self._read(request):
                if not answer.get("conflict"):
                    self._office.ledger.check_saved(request, answer["version"])

        self._simulation.spawn(f"second window {tab}", save)

    def _save_as(self) -> None:
        self._save(self._rng.choice(NAMES))

    def _load(self, name: str) -> None:
        """Open a file; the user discards unsaved edits."""
        answer = self._post("open", {"file": name})
        if answer is None:
            return
        before = self._file
        self._show(answer, {"file": name})
        self._forget(before)
        self._offer(answer["left"])

    def _open(self) -> None:
        listed = self._post("list", {})
        if listed and listed["files"]:
            self._load(self._rng.choice(listed["files"]))

    def _read_messages(self) -> None:
        """Read the messages of the designer."""
        for message in self._socket.messages:
            if message["kind"] == "error" and ("\n" in message["text"] or not message["text"]):
                self._simulation.violate("errors", f"the page got {message['text']!r}")
        self._simulation.count("messages", len(self._socket.messages))
        self._socket.messages.clear()

    # Twins ---------------------------------------------------------------------------------------------

    def _drive(self) -> None:
        """Start a twin, use it for a while and end it."""
        if self._rng.random() < 0.5:
            return
        log = f"log-{self._office.unique()}.mcap" if self._rng.random() < 0.3 else None
        arguments = {"draft": self._draft, "file": self._file, "seed": 1, "log": log}
        if self._post("start", {**arguments, "speed": self._rng.choice([1.0, 0.5, 3.0])}) is None:
            return
        for _ in range(self._rng.randrange(1, 8)):
            self._office.pause(0.05, 1)
            action, arguments = self._rng.choice(
                [
                    ("pace", {"speed": 2.0, "paused": self._rng.random() < 0.5}),
                    ("put", {"robot": 0, "x_mm": 150.0, "y_mm": 150.0, "heading_deg": 90.0}),
                    ("run", {"controllers": ["braitenberg"], "cycles": 10, "runs": 2}),
                    ("run", {"controllers": ["braitenberg"], "seconds": 100}),
                    ("stop", {}),
                    ("step", {}),
                    ("room", {"robot": 0, "x_mm": 10.0, "y_mm": 10.0}),
                ]
            )
            self._post(action, arguments)
            self._read_messages()
        if self._rng.random() < 0.8:
            self._post("end", {})
            self._simulation.count("twins")

    def _ask(self) -> None:
        action = self._rng.choice(["left", "left", "check"])
        arguments = {"draft": self._draft} if action == "check" else {"file": self._file or NAMES[0]}
        self._post(action, arguments)

    def _odd(self) -> None:
        """Send a request that no page would send."""
        if not self._faults.happens("malformed", "pages", 0.5):
            return
        rng = self._faults.drawn("malformed", "pages")
        action = rng.choice(["save", "keep", "open", "start", "hello", "none", "put", "run"])
        body = rng.choice(
            [
                rng.randbytes(rng.randrange(40)),
                b"[]",
                b'{"file": "../x.toml"}',
                b'{"file": 1e999}',
                b"[" * 4000,
            ]
        )
        headers = rng.choice([{}, {}, {"token": "guess"}, {"content-type": "text/plain"}])
        headers |= rng.choice(
            [{}, {}, {"origin": "http://evil"}, {"host": "evil"}, {"content-length": "9" * 8}]
        )
        request = PageRequest(self._simulation, action, {})
        self._designer.ask(request, body, headers, REPLY_TIMEOUT_S)
        self._read(request)


def _write(path: Path, text: str) -> None:
    """Replace a file atomically, as an editor does that renames."""
    other = path.with_name("edited")
    with open(other, "w") as file:
        file.write(text)
    os.replace(other, path)


SCENARIOS = {"page": pages}
