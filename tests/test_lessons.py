"""docs/lessons: the lessons, followed in an empty folder, have the results that they show."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from command_line import khep_twin

from khep_twin.lab.challenge.challenge import load, names
from khep_twin.lab.challenge.task_metrics import UNITS
from tools import tutorial

LESSONS = sorted((tutorial.PAGE.parent / "lessons").glob("0*.md"))
ENVIRONMENT = {
    **os.environ,
    "PYTHONPATH": str(Path(__file__).parents[1]),
    "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}",
}
INDEX = (tutorial.PAGE.parent / "lessons" / "README.md").read_text()


SHARE = {"01_sensor"}


@pytest.mark.parametrize(
    "lesson",
    [
        pytest.param(path, id=path.stem, marks=() if path.stem in SHARE else pytest.mark.long)
        for path in LESSONS
    ],
)
def test_a_learner_who_follows_a_lesson_sees_what_it_shows(
    lesson: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parents[1]))
    blocks = tutorial.blocks(lesson.read_text())
    with tutorial.reader(tmp_path, exact=tutorial.made_with() in INDEX) as person:
        for block in blocks:
            person.follow(block)
    assert re.search(r"^passed ", blocks[-1].text, re.MULTILINE)


def test_every_lesson_and_its_challenge_are_on_the_index() -> None:
    linked = re.findall(r"\]\((0\d_\w+\.md)\)", INDEX)
    assert linked == [path.name for path in LESSONS]
    assert len(linked) == 8
    for path, name in zip(LESSONS, re.findall(r"challenge run (\w+) FILE", INDEX), strict=True):
        assert name in names()
        assert f"khep-twin challenge run {name} " in path.read_text()


def test_the_lessons_begin_with_the_readmes_command() -> None:
    first = tutorial.blocks(INDEX)[0].text.splitlines()
    assert first[:2] == tutorial.blocks(tutorial.PAGE.read_text())[0].text.splitlines()[:2]


@pytest.mark.long
def test_a_teacher_who_follows_the_page_of_challenges_sees_what_it_shows(tmp_path: Path) -> None:
    page = (tutorial.PAGE.parent / "challenges.md").read_text()
    lesson = tutorial.blocks(LESSONS[0].read_text())
    (stop,) = [block.text for block in lesson if block.file]
    (tmp_path / "stop.py").write_text(stop)
    output = ""
    for block in tutorial.blocks(page):
        if block.file:
            (tmp_path / block.file).write_text(block.text)
        elif block.language == "text":
            assert output == block.text
        else:
            shell = ["sh", "-ec"] if block.language == "sh" else [sys.executable, "-c"]
            process = subprocess.run(
                [*shell, block.text], cwd=tmp_path, env=ENVIRONMENT, capture_output=True, text=True
            )
            assert process.returncode == 0, process.stderr
            output = process.stdout
    assert khep_twin("challenge", "show", tmp_path / "mine.toml").returncode == 0


def test_the_page_of_challenges_has_each_with_its_scores_and_each_metric() -> None:
    page = (tutorial.PAGE.parent / "challenges.md").read_text()
    for name in names():
        challenge = load(name).challenge
        assert re.search(
            rf"^\| `{name}` .* \| {challenge.reference:g} \| {challenge.threshold:g} \|$", page, re.M
        )
    for name in [*UNITS][-6:]:
        assert f"| `{name}` | {UNITS[name]}".rstrip() in page
