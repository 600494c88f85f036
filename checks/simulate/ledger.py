"""Ledger of the edits that the page has acknowledged, which must be in the file or in an offered draft."""

import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from checks.simulate.designer import PageRequest
from checks.simulate.simulation import Simulation
from khep_twin import playpen as playpens
from khep_twin.errors import KhepTwinError
from khep_twin.web.documents import Documents, version_of
from khep_twin.web.drafts import draft_of, playpen_of

Place = tuple[str | None, str]
"""File, None for none, and page."""


@dataclass(eq=False)
class Sent:
    """A request that keeps a draft, or gives it up.

    Attributes:
        page: Page that has sent it.
        draft: Draft, as JSON; None to give it up.
        concurrent: Drafts of other pages' requests that were under way at the same time.
    """

    page: str
    draft: str | None
    concurrent: list[str | None] = field(default_factory=list)


@dataclass
class Work:
    """Work of a page on a file.

    Attributes:
        last: Last request that was acknowledged; without a draft if it was saved, discarded or undone.
        underway: Requests that were not, whose outcome is unknown.
    """

    last: Sent = field(default_factory=lambda: Sent("", None))
    underway: list[Sent] = field(default_factory=list)

    @property
    def maybe(self) -> set[str | None]:
        """Drafts that may be in the place of the last one."""
        return {*self.last.concurrent, *(sent.draft for sent in self.underway)}


@dataclass
class Write:
    """A write of a file.

    Attributes:
        version: Version that it made.
        draft: Playpen of it, as JSON.
        request: Request for it; None for another program's.
        time_ns: Time of it [ns].
    """

    version: str
    draft: str
    request: PageRequest | None
    time_ns: int


class Ledger:
    """Ledger of all work in a folder."""

    def __init__(self, simulation: Simulation, folder: Path) -> None:
        self._simulation, self._folder = simulation, folder
        self.works: dict[Place, Work] = {}
        self.writes: dict[str, list[Write]] = {}

    def note_write(self, path: Path, request: PageRequest | None) -> None:
        """Note a write of a file; check that it replaces no other one unasked."""
        name, text = str(path.relative_to(self._folder)), path.read_text("utf-8")
        write = Write(version_of(text), _of_text(text), request, self._simulation.kernel.now_ns)
        before = self.writes.setdefault(name, [])
        if request is not None and request.action == "save":
            self._check_base(name, before[-1] if before else None, request)
            draft = request.arguments["draft"]
            if not request.arguments["rename"] and write.draft != normal(draft):
                self._simulation.violate("work", f"{name} has other content than was saved")
        before.append(write)

    def _check_base(self, name: str, last: Write | None, request: PageRequest) -> None:
        version = None if last is None else last.version
        if request.arguments["overwrite"] or request.arguments["version"] == version or last is None:
            return
        if last.request is None and last.time_ns >= request.began_ns:
            # Another program can still write between the last look and the rename: files have no locks.
            self._simulation.count("races with other programs")
            return
        who = "another program" if last.request is None else f"page {last.request.arguments['tab']}"
        self._simulation.violate("work", f"{name}, changed by {who}, was overwritten unasked")

    def sent(self, place: Place, page: str, draft: str | None) -> Sent:
        """Note that a page keeps a draft, or with None gives it up."""
        work = self.works.setdefault(place, Work())
        others = [other for other in work.underway if other.page != page]
        new = Sent(page, draft, [other.draft for other in others])
        for other in others:
            other.concurrent.append(draft)
        work.underway.append(new)
        return new

    def answered(self, place: Place, sent: Sent) -> None:
        """Note that a request was acknowledged, after all that its page has sent before."""
        work = self.works[place]
        work.underway = [other for other in work.underway if other.page != sent.page]
        work.last = sent

    def check_saved(self, request: PageRequest, version: str) -> None:
        """Check that an acknowledged save has written the reported version."""
        if not any(
            write.request is request and write.version == version
            for write in self.writes.get(request.arguments["file"], [])
        ):
            self._simulation.violate("work", f"{request.arguments['file']} was acknowledged and not written")

    def check(self) -> None:
        """Check that all that was acknowledged is in its file, or in a draft that is offered."""
        documents = Documents(self._folder)
        offers: dict[str | None, list[dict[str, object]]] = {}
        for (file, page), work in self.works.items():
            if work.last.draft is None or None in work.maybe:
                continue
            if file not in offers:
                offers[file] = documents.drafts(file)
            right = {work.last.draft, *work.maybe}
            offered = {as_json(offer["draft"]) for offer in offers[file] if offer["page"] == page}
            if offered & right:
                continue
            written = [
                write for writes in self.writes.values() for write in writes if write.request is not None
            ]
            if not any(
                write.request.arguments["tab"] == page and as_json(write.request.arguments["draft"]) in right
                for write in written
                if write.request is not None
            ):
                self._simulation.violate("work", f"the last edit of page {page} in {file} is lost")
            self._simulation.count("works in files")
        self._simulation.count("works checked", len(self.works))


def as_json(draft: Any) -> str:
    """Return a draft as JSON."""
    return json.dumps(draft, sort_keys=True)


def normal(draft: Any) -> str:
    """Return a valid draft as its file has it."""
    return as_json(draft_of(playpen_of(draft)))


def _of_text(text: str) -> str:
    try:
        return as_json(draft_of(playpens.parse(text, "a file")))
    except KhepTwinError:
        return ""
