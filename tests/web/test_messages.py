"""The designer and its page have the same kinds of messages, the same actions."""

import re
from pathlib import Path
from typing import get_args, get_type_hints

from PIL import Image

from khep_twin.playpen.bitmap_files import PICTURES
from khep_twin.web.documents import Documents
from khep_twin.web.messages import Message
from khep_twin.web.routes import ASSETS, Page

SCRIPTS = {path.name: path.read_text() for path in ASSETS.glob("*.js") if not path.name.startswith("three.")}
ACTIONS = set(Page(Documents(Path()), None).actions)


def message_kinds(script: str) -> list[str]:
    """Return the kinds of messages in the table of a script."""
    table = re.search(r"^( *)messageHandlers = \{\n(.*?)^\1\};", script, re.DOTALL | re.MULTILINE)
    assert table is not None
    indent = re.escape(f"{table[1]}  ")
    return re.findall(rf'^{indent}"?([\w-]+)"?[:(]', table[2], re.MULTILINE)


def test_the_page_has_one_function_for_each_kind_of_message() -> None:
    kinds = [
        kind for name in ("run.js", "challenges.js", "drafts.js") for kind in message_kinds(SCRIPTS[name])
    ]
    types = (get_type_hints(message)["kind"] for message in get_args(Message))
    assert sorted(kinds) == sorted(kind for literal in types for kind in get_args(literal))


def test_each_button_that_asks_for_an_action_has_one_and_is_enabled_by_a_state_that_there_is() -> None:
    page = (ASSETS / "index.html").read_text()
    posts = re.findall(r'data-post="([\w-]+)"', page)
    assert posts
    assert set(posts) <= ACTIONS
    states = re.search(r"const WHEN = \{\n(.*?)^\};", SCRIPTS["run.js"], re.DOTALL | re.MULTILINE)
    assert states is not None
    state_names = re.findall(r'^  "?([\w-]+)"?:', states[1], re.MULTILINE)
    assert set(re.findall(r'data-when="([\w-]+)"', page)) == set(state_names)


def test_the_page_asks_for_all_actions_and_for_no_other() -> None:
    page = (ASSETS / "index.html").read_text()
    actions = set(re.findall(r'post\("([\w-]+)"', "".join(SCRIPTS.values())))
    # A move by hand and its undo are requested by name (hands.js).
    actions |= set(re.findall(r'\["(put|switch)", ', SCRIPTS["handling.js"]))
    assert actions | set(re.findall(r'data-post="([\w-]+)"', page)) == ACTIONS


def test_the_page_offers_all_kinds_of_pictures_that_are_read_for_an_import() -> None:
    offered = re.search(r'id="import" accept="\.mat,([^"]*)"', (ASSETS / "index.html").read_text())
    assert offered is not None
    assert {Image.registered_extensions()[suffix] for suffix in offered[1].split(",")} == set(PICTURES)
