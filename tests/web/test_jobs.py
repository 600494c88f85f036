"""Programs of the page are read from their files at the start of each run."""

from pathlib import Path

from khep_twin.web.documents import Documents
from khep_twin.web.jobs import series_job
from khep_twin.web.requests import RunRequest


def test_a_program_has_the_modules_beside_it_as_they_are_now(tmp_path: Path) -> None:
    """Not those of an earlier run, nor those of a program in another folder."""

    def speed(folder: str) -> object:
        request = RunRequest(controllers=(f"{folder}/mine.py",), cycles=1)
        return series_job(request, Documents(tmp_path)).controller(None)  # type: ignore[operator, arg-type]

    for folder, text in (("a", "1"), ("b", "22")):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "steering.py").write_text(f"def speed():\n    return {text}\n")
        mine = "import steering\n\ndef controller(robot):\n    return steering.speed()\n"
        (tmp_path / folder / "mine.py").write_text(mine)
    assert (speed("a"), speed("b"), speed("a")) == (1, 22, 1)
    (tmp_path / "a" / "steering.py").write_text("def speed():\n    return 333\n")
    assert speed("a") == 333
