"""Files below one folder: playpens, drafts and imports."""

import json
import os
import threading
from io import BytesIO
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy.io import savemat  # pyright: ignore[reportMissingTypeStubs, reportUnknownVariableType]

from khep_twin import playpen as playpens
from khep_twin.board.turrets import installed_turrets
from khep_twin.errors import KhepTwinError, PlaypenError
from khep_twin.playpen import Playpen
from khep_twin.web.documents import ConflictError, Documents, OutsideError
from khep_twin.web.drafts import blank, draft_of, problems_of
from tests.drawn_bitmap import drawn
from tests.web.conftest import Client, run_server

MINE = """# My own.
version = 1
name = "mine"

[arena]
width_mm = 600  # measured
height_mm = 500

[[robot]] # the robot
x_mm = 300
y_mm = 250
heading_deg = 90
"""


@pytest.fixture
def documents(tmp_path: Path) -> Documents:
    """A folder with a playpen file."""
    (tmp_path / "mine.toml").write_text(MINE)
    return Documents(tmp_path)


def test_comments_stay_in_a_file_that_is_saved(documents: Documents, tmp_path: Path) -> None:
    opened = documents.open("mine.toml")
    opened["draft"]["robot"][0]["x_mm"] = 200
    version = documents.save(
        "mine.toml", opened["draft"], version=opened["version"], base={"file": "mine.toml"}
    )
    text = (tmp_path / "mine.toml").read_text()
    assert text == MINE.replace("x_mm = 300", "x_mm = 200.0")
    assert documents.version("mine.toml") == version != opened["version"]


def test_a_playpen_of_the_library_keeps_its_comments_under_a_new_name(tmp_path: Path) -> None:
    documents = Documents(tmp_path)
    document = documents.library("obstacles")
    documents.save("new.toml", document["draft"], version=None, base={"library": "obstacles"})
    assert "wedged nowhere" in (tmp_path / "new.toml").read_text()


def test_a_file_that_has_changed_meanwhile_is_not_written_over(documents: Documents, tmp_path: Path) -> None:
    opened = documents.open("mine.toml")
    (tmp_path / "mine.toml").write_text(MINE + "# by another\n")
    with pytest.raises(ConflictError):
        documents.save("mine.toml", opened["draft"], version=opened["version"], base={})
    with pytest.raises(ConflictError):
        documents.save("mine.toml", opened["draft"], version=None, base={})
    assert "by another" in (tmp_path / "mine.toml").read_text()
    documents.save("mine.toml", opened["draft"], version=None, base={}, overwrite=True)


def test_of_two_pages_that_save_at_once_one_is_told_of_the_other(
    documents: Documents, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: Any = documents.open("mine.toml")
    ends: dict[str, str] = {}

    def save(name: str) -> None:
        draft = {**opened["draft"], "name": name}
        try:
            documents.save("mine.toml", draft, version=opened["version"], base={}, page=name)
            ends[name] = "saved"
        except ConflictError:
            ends[name] = "conflict"

    other = threading.Thread(target=save, args=["second"])

    def slowly(path: Path, data: bytes) -> None:
        if other.ident is None:
            other.start()
            other.join(0.2)  # it waits for this one
        path.write_bytes(data)

    monkeypatch.setattr("khep_twin.web.documents.write_atomic", slowly)
    save("first")
    other.join()
    assert ends == {"first": "saved", "second": "conflict"}
    assert Playpen.load(tmp_path / "mine.toml").name == "first"


def test_a_file_that_changes_while_its_new_text_is_made_is_not_written_over(
    documents: Documents, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened: Any = documents.open("mine.toml")

    def edit_file(*_: object) -> str:
        (tmp_path / "mine.toml").write_text(MINE.replace("600", "700"))
        return MINE

    monkeypatch.setattr("khep_twin.web.documents.text_of", edit_file)
    with pytest.raises(ConflictError, match=r"mine.toml: was changed by another page or program"):
        documents.save("mine.toml", opened["draft"], version=opened["version"], base={})
    assert "700" in (tmp_path / "mine.toml").read_text()


def test_a_read_only_file_is_not_written_over_and_keeps_its_draft(tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text(MINE)
    (tmp_path / "mine.toml").chmod(0o444)
    documents = Documents(tmp_path)
    opened = documents.open("mine.toml")
    opened["draft"]["robot"][0]["x_mm"] = 200
    documents.save_draft("mine.toml", opened["draft"])
    with pytest.raises(KhepTwinError, match=r"mine.toml: cannot be written: the file is read-only"):
        documents.save("mine.toml", opened["draft"], version=opened["version"], base={"file": "mine.toml"})
    assert (tmp_path / "mine.toml").read_text() == MINE
    assert [entry["draft"] for entry in documents.drafts("mine.toml")] == [opened["draft"]]


def test_what_was_worked_on_last_is_opened_first(client: Client, tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text(MINE)
    new = client.do("hello")[1]
    assert (new["file"], len(new["draft"]["robot"])) == (None, 1)
    draft = client.do("open", file="mine.toml")[1]["draft"]
    assert client.do("hello")[1]["file"] == "mine.toml"
    draft["robot"][0]["x_mm"] = 100
    client.do("keep", file=None, draft=draft)
    hello = client.do("hello")[1]
    assert (hello["file"], [entry["draft"] for entry in hello["left"]]) == (None, [draft])


def test_a_draft_with_a_mistake_leaves_the_file_as_it_was(documents: Documents, tmp_path: Path) -> None:
    opened = documents.open("mine.toml")
    opened["draft"]["robot"][0]["x_mm"] = 5
    with pytest.raises(PlaypenError, match="overlaps the left wall"):
        documents.save("mine.toml", opened["draft"], version=opened["version"], base={})
    assert (tmp_path / "mine.toml").read_text() == MINE


def test_a_draft_is_kept_until_it_is_saved(documents: Documents, tmp_path: Path) -> None:
    opened = documents.open("mine.toml")
    version = opened["version"]
    content = {
        "draft": {**opened["draft"], "robot": "half"},
        "version": version,
        "base": {"file": "mine.toml"},
    }
    documents.save_draft("mine.toml", content, "1-2")
    [left] = documents.open("mine.toml")["left"]
    assert left == {**content, "page": "1-2", "time": left["time"]}
    assert documents.names() == ["mine.toml"]
    documents.save("mine.toml", opened["draft"], version=version, base={}, page="1-2")
    assert documents.open("mine.toml")["left"] == []
    assert [path.name for path in tmp_path.iterdir()] == ["mine.toml"]


def test_a_page_that_saves_leaves_the_drafts_of_other_pages_and_documents(tmp_path: Path) -> None:
    documents = Documents(tmp_path)
    draft = documents.new("mine.toml")["draft"]
    for name in ("mine.toml", "mine.toml.1-1.toml", None):
        for page in ("1-1", "2-2"):
            documents.save_draft(name, {"draft": {**draft, "name": f"{name} {page}"}}, page)
    documents.save("mine.toml", draft, version=None, base={}, page="1-1")
    assert [entry["draft"]["name"] for entry in documents.drafts("mine.toml")] == ["mine.toml 2-2"]
    for name in ("mine.toml.1-1.toml", None):
        assert {entry["draft"]["name"] for entry in documents.drafts(name)} == {f"{name} 1-1", f"{name} 2-2"}


def test_a_draft_of_an_earlier_version_is_still_offered_and_what_is_none_is_not(
    tmp_path: Path,
) -> None:
    documents = Documents(tmp_path)
    (tmp_path / ".mine.toml.draft").write_text('{"name": "mine"}')
    (tmp_path / ".mine.toml.1.draft").write_text("{")
    (tmp_path / ".mine.toml.2.draft").symlink_to(tmp_path / ".mine.toml.draft")
    (tmp_path / ".mine.toml.3.draft").mkdir()
    [left] = documents.drafts("mine.toml")
    assert (left["draft"], left["page"]) == ({"name": "mine"}, "")


@pytest.mark.share(3)
@pytest.mark.parametrize(
    ("file", "name"),
    [
        ("my pen.toml", "my-pen"),
        ("größe.toml", "gro-e"),
        ("a.b.toml", "a-b"),
        ("été 2.toml", "ete-2"),
        ("迷路.toml", "playpen"),
        ("[x]*?.toml", "x"),
        ("'\".toml", "playpen"),
        ("n" * 100 + ".toml", "n" * 64),
    ],
)
def test_any_name_of_a_file_will_do(tmp_path: Path, file: str, name: str) -> None:
    with run_server(tmp_path, file) as client:
        status, hello = client.do("hello")
        assert (status, hello["file"], hello["draft"]["name"]) == (200, file, name)
        assert client.do("keep", file=file, draft={"half": 1}, tab="7-7") == (200, {})
        assert client.do("hello")[1]["left"][0]["draft"] == {"half": 1}
        saved = client.do("save", file=file, draft=hello["draft"], version=None, base={}, tab="7-7")
        assert (saved[0], saved[1]["name"]) == (200, name)
        assert client.do("hello")[1]["left"] == []
        # For example if a playpen of another name is saved under this file name.
        renamed = {**hello["draft"], "name": "other"}
        request = {"file": file, "draft": renamed, "version": saved[1]["version"], "base": {}, "rename": True}
        assert client.do("save", **request)[1]["name"] == Playpen.load(tmp_path / file).name == name


def test_a_page_loaded_again_gets_its_own_document(client: Client, tmp_path: Path) -> None:
    (tmp_path / "mine.toml").write_text(MINE)
    assert client.do("open", file="mine.toml")[0] == 200
    assert client.do("hello")[1]["file"] == "mine.toml"
    assert client.do("hello", file=None)[1]["file"] is None
    assert client.do("hello", file="new one.toml")[1]["draft"]["name"] == "new-one"
    (tmp_path / "mine.toml").write_text("broken")
    hello = client.do("hello")[1]
    assert hello["file"] is None
    assert "mine.toml" in hello["trouble"]


@pytest.mark.parametrize("name", ["../x.toml", "/x.toml", "a/../../x.toml", "a\\x.toml", "x\n.toml"])
def test_names_lead_nowhere_else(tmp_path: Path, name: str) -> None:
    with pytest.raises(OutsideError):
        Documents(tmp_path).path(name, ".toml")


@pytest.mark.parametrize("name", ["x.py", ".x.toml", "x"])
def test_other_files_are_left_alone(tmp_path: Path, name: str) -> None:
    with pytest.raises(PlaypenError):
        Documents(tmp_path).path(name, ".toml")


def test_each_problem_of_a_draft_has_its_place() -> None:
    draft = draft_of(playpens.parse(MINE, "mine"))
    draft["robot"].append({"x_mm": 310, "y_mm": 250, "heading_deg": 0})
    draft["lamp"] = [{"x_mm": 10, "y_mm": 10, "power_w": 7}, {"x_mm": "here", "y_mm": 1, "power_w": 7}]
    [shape] = problems_of(draft)
    assert shape["place"] == ["lamp", 1, "x_mm"]
    del draft["lamp"]
    [overlap] = problems_of(draft)
    assert overlap["place"][:2] == ["robot", 1]
    assert "overlaps robot 1" in overlap["text"]


@pytest.mark.parametrize("draft", [{}, {"arena": 3}, {"robot": [[[]]]}, {"block": {"x": 1}}, {"name": None}])
def test_any_draft_is_reported_what_is_wrong_with_it(client: Client, draft: dict[str, object]) -> None:
    status, answer = client.do("check", draft=draft)
    assert status == 200
    assert answer["problems"]


def test_no_json_is_reported(client: Client) -> None:
    for body in (b"", b"[]", b"{", b"[" * 100_000, b'{"draft": 1}', b"\xff"):
        assert client.raw("POST", f"{client.base}/do/check", client.headers(), body)[0] == 400


def test_refusals_name_no_options_of_the_command_line(client: Client, tmp_path: Path) -> None:
    headers = client.headers(Content_Type="application/octet-stream")
    scans: list[tuple[dict[str, Any], str, str]] = [
        ({"a": np.eye(50), "b": np.eye(60)}, "1", "several matrices (a: 50 x 50, b: 60 x 60)"),
        ({"btmap1": np.eye(50)}, "1", "btmap1: no pixel is 44"),
        ({"btmap1": np.eye(200) * 44}, "0.6", "a block of 0.6 mm; expected at least 1 mm"),
        ({"btmap1": np.eye(50) * 44}, "0", "0 mm per pixel: expected 0.001 to 1000"),
        ({"btmap1": np.eye(50) * 44}, "nan", "nan mm per pixel: expected 0.001 to 1000"),
        ({"btmap1": np.eye(50) * 44}, "1", "an arena of 50 x 50 mm within the walls"),
    ]
    for matrices, scale, reason in scans:
        data = BytesIO()
        savemat(data, matrices)
        path = f"{client.base}/import?name=scan.mat&mm={scale}"
        status, body = client.raw("POST", path, headers, data.getvalue())
        assert status == 400
        assert reason in json.loads(body)["error"]
        assert "--" not in json.loads(body)["error"]


def test_a_scan_becomes_a_playpen(client: Client) -> None:
    picture = BytesIO()
    Image.fromarray(~drawn()).save(picture, format="PNG")
    headers = client.headers(Content_Type="application/octet-stream")
    status, body = client.raw("POST", f"{client.base}/import?name=scan.png&mm=2", headers, picture.getvalue())
    assert status == 200, body
    assert json.loads(body)["draft"]["arena"]["width_mm"] == 1160
    assert client.raw("POST", f"{client.base}/import?name=scan.mat", headers, b"rubbish")[0] == 400


def test_a_name_too_long_for_its_draft_is_refused_before_the_file_is_written(
    client: Client, tmp_path: Path
) -> None:
    status, reply = client.do("save", file="x" * 240 + ".toml", tab="1-2345678", draft=blank("p"))
    assert (status, reply["error"]) == (400, "File name too long")
    assert not [*tmp_path.glob("x*")]


def test_a_file_that_has_something_in_it_is_no_place_for_a_new_one(tmp_path: Path) -> None:
    documents = Documents(tmp_path)
    (tmp_path / "run.mcap").write_bytes(b"a run")
    with pytest.raises(PlaypenError, match=r"run\.mcap: is there already; expected the name of a new file"):
        documents.new_path("run.mcap", ".mcap")
    (tmp_path / "empty.mcap").touch()
    for name in ("empty.mcap", "other.mcap"):
        assert documents.new_path(name, ".mcap") == tmp_path / name


def test_a_name_that_is_no_utf_8_hides_no_other_file(client: Client, tmp_path: Path) -> None:
    for name in (b"caf\xe9.toml", b"caf\xe9.py", b"mine.toml", b"mine.py"):
        (tmp_path / os.fsdecode(name)).touch()
    status, reply = client.do("list")
    assert (status, reply.get("files"), reply.get("programs")) == (200, ["mine.toml"], ["mine.py"])


def test_a_file_that_was_broken_meanwhile_can_be_replaced_or_left_for_another(
    client: Client, tmp_path: Path
) -> None:
    draft = draft_of(Playpen.load("two-lamps"))
    _, saved = client.do("save", file="mine.toml", draft=draft)
    (tmp_path / "mine.toml").write_text("version = [1\n")  # by an editor
    request = {"draft": draft, "version": saved["version"], "base": {"file": "mine.toml"}}
    assert client.do("save", file="mine.toml", **request)[0] == 409
    assert client.do("save", file="other.toml", **{**request, "version": None})[0] == 200
    assert client.do("save", file="mine.toml", overwrite=True, **request)[0] == 200
    for name in ("mine.toml", "other.toml"):
        assert draft_of(Playpen.load(tmp_path / name)) == draft


def test_no_choice_that_the_page_offers_for_a_model_is_refused(client: Client) -> None:
    for name, choices in client.do("hello")[1]["models"].items():
        turrets = [*installed_turrets()] if choices["has_turrets"] else []
        for rom, modes in choices["modes"].items():
            for mode, calibration in product(map(int, modes), choices["calibrations"]):
                robot = {"x_mm": 1000, "y_mm": 1000, "heading_deg": 0, "model": name, "rom": rom}
                robot |= {"mode": mode, "calibration": calibration, "turrets": turrets}
                draft = {"version": 1, "name": "all", "arena": {"width_mm": 2000, "height_mm": 2000}}
                assert problems_of({**draft, "robot": [robot]}) == []
