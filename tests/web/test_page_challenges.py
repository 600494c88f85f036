"""Programs are scored for the page: one at a time, in a process that ends with the page and the designer."""

import os
from collections.abc import Iterator, Mapping
from pathlib import Path

import pytest

from khep_twin.errors import ChallengeError
from khep_twin.lab.challenge.challenge import names
from khep_twin.web import challenges
from khep_twin.web.challenges import Challenges
from khep_twin.web.documents import Documents, OutsideError
from khep_twin.web.requests import Request as Plain
from khep_twin.web.requests import ScoreRequest, ScoreTableRequest
from tests.web.conftest import Asker, Ear

DRIVES = "def controller(robot):\n    robot.set_speed(5, 5)\n    print('driven')\n    robot.sleep(30)\n"
FAILS = "def controller(robot):\n    robot.proximity()\n    nonsense()\n"
WAITS = (
    "import os, time\nfrom pathlib import Path\n"
    "Path(__file__).with_suffix('.pid').write_text(str(os.getpid()))\n"
    "print('here', flush=True)\ntime.sleep(600)\n"
)


@pytest.fixture
def page(tmp_path: Path, ear: Ear, monkeypatch: pytest.MonkeyPatch) -> Iterator[Challenges]:
    """The challenges of a page that is open."""
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[2]))
    for name, text in (("drives", DRIVES), ("fails", FAILS), ("waits", WAITS)):
        (tmp_path / f"{name}.py").write_text(text)
    found = Challenges(Documents(tmp_path), ear, lambda: True)
    yield found
    found.close()


def ask(page: Challenges, action: str, **wanted: str) -> object:
    kind, act = page.actions[action]
    return act(kind.model_validate(wanted))


def half(told: Mapping[str, object]) -> bool:
    return told["part"] == 0.5


def whole(told: Mapping[str, object]) -> bool:
    return told["part"] == 1


def is_gone(folder: Path) -> bool:
    """Whether the process that waits there has been ended; its keeper reaps it."""
    try:
        os.kill(int((folder / "waits.pid").read_text()), 0)
    except ProcessLookupError:
        return True
    return False


def test_the_page_gets_each_challenge_with_its_task_and_its_picture(asker: Asker) -> None:
    status, found = asker.do("challenges")
    assert (status, [*found["challenges"]], found["now"]) == (200, names(), None)
    maze = found["challenges"]["maze"]
    assert maze["playpen"] == "t-maze"
    assert maze["facts"] == {
        "metric": "goal_s [s], lower is better",
        "penalty": "1 for each of collisions",
        "time": "4 runs of 40 s",
        "passed": "at most 15 s",
        "reference": "8.07 s",
    }
    assert asker.do("challenge-picture", name="maze")[1].startswith(b"\x89PNG")
    status, told = asker.do("challenge-picture", name="../maze")
    assert (status, told["error"].partition(";")[0]) == (400, "../maze: no such challenge")


def test_a_program_is_scored_and_what_it_prints_comes_before(page: Challenges, ear: Ear) -> None:
    ask(page, "score", challenge="stop", program="drives.py")
    assert ear.wait("scoring") == {"kind": "scoring", "challenge": "stop", "program": "drives.py"}
    assert ear.wait("score-printed")["text"].startswith("driven")
    found = ear.wait("scored")
    assert (found["program"], found["passes"], len(found["runs"])) == ("drives.py", False, 3)
    assert (found["threshold"], found["reference"]) == ("at least 0.5 of the time", "0.8992 of the time")
    assert ear.wait("score-ended")["text"] == ""


def test_a_program_that_fails_has_one_line_with_its_place(page: Challenges, ear: Ear) -> None:
    ask(page, "score", challenge="stop", program="fails.py")
    found = ear.wait("scored")
    assert found["score"] is None
    assert found["reason"] == "fails.py:3: NameError: name 'nonsense' is not defined"


def test_a_second_attempt_is_refused_and_a_stopped_one_leaves_no_process(
    page: Challenges, ear: Ear, tmp_path: Path
) -> None:
    ask(page, "score", challenge="stop", program="waits.py")
    assert ear.wait("score-printed")["text"].startswith("here")
    for action in ("score", "score-table"):
        with pytest.raises(ChallengeError, match=r"^waits.py is being scored; expected to wait for it, or"):
            ask(page, action, challenge="stop")
    assert ask(page, "challenges")["now"]["program"] == "waits.py"  # pyright: ignore
    ask(page, "score-stop")
    assert ear.wait("score-ended")["text"] == "stopped"
    assert is_gone(tmp_path)
    assert ask(page, "challenges")["now"] is None  # pyright: ignore


@pytest.mark.long
@pytest.mark.parametrize("end", ["designer", "pages"])
def test_without_a_designer_or_an_open_page_no_process_is_left(
    page: Challenges, ear: Ear, tmp_path: Path, end: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    ask(page, "score", challenge="stop", program="waits.py")
    ear.wait("score-printed")
    if end == "designer":
        page.close()
        assert is_gone(tmp_path)
        return
    monkeypatch.setattr(challenges, "_UNWATCHED", 0.2)
    monkeypatch.setattr(page, "_watched", lambda: False)
    assert ear.wait("score-ended")["text"] == "stopped"
    assert is_gone(tmp_path)


def test_a_folder_is_scored_row_by_row_and_its_table_is_that_of_the_command(
    page: Challenges, ear: Ear, tmp_path: Path
) -> None:
    (tmp_path / "class").mkdir()
    (tmp_path / "class" / "anna.py").write_text(DRIVES)
    (tmp_path / "class" / "ben.py").write_text(FAILS)
    with pytest.raises(ChallengeError, match="no program of a folder was scored yet"):
        ask(page, "score-csv")
    ask(page, "score-table", challenge="stop", folder="class")
    assert len(ear.wait("score-rows", half)["rows"]) == 1
    first, last = ear.wait("score-rows", whole)["rows"]
    assert (first["rank"], first["participant"], first["passes"]) == (1, "anna", False)
    reason = "class/ben.py:3: NameError: name 'nonsense' is not defined"
    assert last == {"rank": None, "participant": "ben", "score": "", "passes": None, "note": reason}
    ear.wait("score-ended")
    rows = ask(page, "score-csv").body.decode().splitlines()  # pyright: ignore
    assert rows[0] == "rank,participant,score,passed,note,run_1,run_2,run_3"
    assert rows[2] == f",ben,,,{reason},,,"


@pytest.mark.parametrize(
    ("asked", "reason"),
    [
        (ScoreRequest(challenge="stop", program="../out.py"), OutsideError),
        (ScoreRequest(challenge="stop", program="link.py"), OutsideError),
        (ScoreRequest(challenge="stop", program="pen.toml"), Exception),
        (ScoreRequest(challenge="stop", program="nowhere.py"), ChallengeError),
        (ScoreRequest(challenge="../pen.toml", program="drives.py"), ChallengeError),
        (ScoreTableRequest(challenge="stop", folder=".."), OutsideError),
        (ScoreTableRequest(challenge="stop", folder="linked"), OutsideError),
        (ScoreTableRequest(challenge="stop", folder="."), OutsideError),
        (ScoreTableRequest(challenge="stop", folder="nowhere"), ChallengeError),
    ],
    ids=lambda value: getattr(value, "program", None) or getattr(value, "folder", None) or value.__name__,
)
def test_no_other_file_is_scored(
    page: Challenges,
    ear: Ear,
    tmp_path_factory: pytest.TempPathFactory,
    tmp_path: Path,
    asked: Plain,
    reason: type[Exception],
) -> None:
    outside = tmp_path_factory.mktemp("outside")
    (outside / "out.py").write_text(DRIVES)
    (tmp_path / "link.py").symlink_to(outside / "out.py")
    (tmp_path / "linked").symlink_to(outside)
    name = "score" if isinstance(asked, ScoreRequest) else "score-table"
    with pytest.raises(reason):
        page.actions[name][1](asked)
    assert ear.heard == []
