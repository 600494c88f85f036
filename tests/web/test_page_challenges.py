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
from tests.web.conftest import Client, Inbox

DRIVES = "def controller(robot):\n    robot.set_speed(5, 5)\n    print('driven')\n    robot.sleep(30)\n"
FAILS = "def controller(robot):\n    robot.proximity()\n    nonsense()\n"
WAITS = (
    "import os, time\nfrom pathlib import Path\n"
    "Path(__file__).with_suffix('.pid').write_text(str(os.getpid()))\n"
    "print('here', flush=True)\ntime.sleep(600)\n"
)


@pytest.fixture
def page(tmp_path: Path, inbox: Inbox, monkeypatch: pytest.MonkeyPatch) -> Iterator[Challenges]:
    """Challenges of an open page."""
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[2]))
    for name, text in (("drives", DRIVES), ("fails", FAILS), ("waits", WAITS)):
        (tmp_path / f"{name}.py").write_text(text)
    challenges = Challenges(Documents(tmp_path), inbox, lambda: True)
    yield challenges
    challenges.close()


def ask(page: Challenges, action: str, **values: str) -> object:
    kind, act = page.actions[action]
    return act(kind.model_validate(values))


def is_half(message: Mapping[str, object]) -> bool:
    return message["part"] == 0.5


def is_complete(message: Mapping[str, object]) -> bool:
    return message["part"] == 1


def is_gone(folder: Path) -> bool:
    """Return whether the waiting process of a folder has ended; its keeper reaps it."""
    try:
        os.kill(int((folder / "waits.pid").read_text()), 0)
    except ProcessLookupError:
        return True
    return False


def test_the_page_gets_each_challenge_with_its_task_and_its_picture(client: Client) -> None:
    status, reply = client.do("challenges")
    assert (status, [*reply["challenges"]], reply["now"]) == (200, names(), None)
    maze = reply["challenges"]["maze"]
    assert maze["playpen"] == "t-maze"
    assert maze["facts"] == {
        "metric": "goal_s [s], lower is better",
        "penalty": "1 for each of collisions",
        "time": "4 runs of 40 s",
        "passed": "at most 15 s",
        "reference": "8.07 s",
    }
    assert client.do("challenge-picture", name="maze")[1].startswith(b"\x89PNG")
    status, reply = client.do("challenge-picture", name="../maze")
    assert (status, reply["error"].partition(";")[0]) == (400, "../maze: no such challenge")


def test_a_program_is_scored_and_what_it_prints_comes_before(page: Challenges, inbox: Inbox) -> None:
    ask(page, "score", challenge="stop", program="drives.py")
    assert inbox.wait("scoring") == {"kind": "scoring", "challenge": "stop", "program": "drives.py"}
    assert inbox.wait("score-printed")["text"].startswith("driven")
    score = inbox.wait("scored")
    assert (score["program"], score["passes"], len(score["runs"])) == ("drives.py", False, 3)
    assert (score["threshold"], score["reference"]) == ("at least 0.5 of the time", "0.8992 of the time")
    assert inbox.wait("score-ended")["text"] == ""


def test_a_program_that_fails_has_one_line_with_its_place(page: Challenges, inbox: Inbox) -> None:
    ask(page, "score", challenge="stop", program="fails.py")
    score = inbox.wait("scored")
    assert score["score"] is None
    assert score["reason"] == "fails.py:3: NameError: name 'nonsense' is not defined"


def test_a_second_attempt_is_refused_and_a_stopped_one_leaves_no_process(
    page: Challenges, inbox: Inbox, tmp_path: Path
) -> None:
    ask(page, "score", challenge="stop", program="waits.py")
    assert inbox.wait("score-printed")["text"].startswith("here")
    for action in ("score", "score-table"):
        with pytest.raises(ChallengeError, match=r"^waits.py is being scored; expected to wait for it, or"):
            ask(page, action, challenge="stop")
    assert ask(page, "challenges")["now"]["program"] == "waits.py"  # pyright: ignore
    ask(page, "score-stop")
    assert inbox.wait("score-ended")["text"] == "stopped"
    assert is_gone(tmp_path)
    assert ask(page, "challenges")["now"] is None  # pyright: ignore


@pytest.mark.long
@pytest.mark.parametrize("end", ["designer", "pages"])
def test_without_a_designer_or_an_open_page_no_process_is_left(
    page: Challenges, inbox: Inbox, tmp_path: Path, end: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    ask(page, "score", challenge="stop", program="waits.py")
    inbox.wait("score-printed")
    if end == "designer":
        page.close()
        assert is_gone(tmp_path)
        return
    monkeypatch.setattr(challenges, "_PAGE_TIMEOUT", 0.2)
    monkeypatch.setattr(page, "_is_watched", lambda: False)
    assert inbox.wait("score-ended")["text"] == "stopped"
    assert is_gone(tmp_path)


@pytest.mark.long
def test_a_folder_is_scored_row_by_row_and_its_table_is_that_of_the_command(
    page: Challenges, inbox: Inbox, tmp_path: Path
) -> None:
    (tmp_path / "class").mkdir()
    (tmp_path / "class" / "anna.py").write_text(DRIVES)
    (tmp_path / "class" / "ben.py").write_text(FAILS)
    with pytest.raises(ChallengeError, match="no program of a folder was scored yet"):
        ask(page, "score-csv")
    ask(page, "score-table", challenge="stop", folder="class")
    assert len(inbox.wait("score-rows", is_half)["rows"]) == 1
    first, last = inbox.wait("score-rows", is_complete)["rows"]
    assert (first["rank"], first["participant"], first["passes"]) == (1, "anna", False)
    reason = "class/ben.py:3: NameError: name 'nonsense' is not defined"
    assert last == {"rank": None, "participant": "ben", "score": "", "passes": None, "note": reason}
    inbox.wait("score-ended")
    rows = ask(page, "score-csv").body.decode().splitlines()  # pyright: ignore
    assert rows[0] == "rank,participant,score,passed,note,run_1,run_2,run_3"
    assert rows[2] == f",ben,,,{reason},,,"


@pytest.mark.parametrize(
    ("score_request", "error"),
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
    inbox: Inbox,
    tmp_path_factory: pytest.TempPathFactory,
    tmp_path: Path,
    score_request: Plain,
    error: type[Exception],
) -> None:
    outside = tmp_path_factory.mktemp("outside")
    (outside / "out.py").write_text(DRIVES)
    (tmp_path / "link.py").symlink_to(outside / "out.py")
    (tmp_path / "linked").symlink_to(outside)
    name = "score" if isinstance(score_request, ScoreRequest) else "score-table"
    with pytest.raises(error):
        page.actions[name][1](score_request)
    assert inbox.messages == []
