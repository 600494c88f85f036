"""Calibration session: steps of a person and a robot, saved in a folder after each step.

Each recording is written completely or not at all. A step is complete when `tests.txt` has its word: a line
NAME=MEASUREMENT in the form of `fit_inputs`, with the recording's name in the folder. An aborted session
resumes after its last complete step.
"""

from collections.abc import Callable, Sequence
from pathlib import Path

from khep_twin.errors import FitError
from khep_twin.files.atomic import read_regular, write_atomic
from khep_twin.files.text import decode
from khep_twin.host.host_robot import HostRobot
from khep_twin.lab.fit.fit_inputs import fit_inputs
from khep_twin.lab.fit.session_people import Person
from khep_twin.lab.fit.session_steps import Step, record

WORDS_FILE = "tests.txt"
"""Name of the file with the words."""

_MAX_BYTES = 100_000
"""Largest file of words [bytes]."""


class CalibrationSession:
    """Calibration session in a folder.

    Args:
        folder: Folder of the recordings; it is created with the first recording.

    Attributes:
        folder: Folder of the recordings.
        words: Words of the complete steps, without the folder.

    Raises:
        FitError: The folder cannot be used, or its words are invalid or lack a recording.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        if folder.exists() and not folder.is_dir():
            raise FitError(f"{folder}: no directory; expected one for the recordings")
        self.words: list[str] = []
        path = folder / WORDS_FILE
        if not path.exists():
            if folder.is_dir() and (names := sorted(entry.name for entry in folder.iterdir())):
                raise FitError(f"{folder}: holds {names[0]} and no {WORDS_FILE}; expected another folder")
            return
        try:
            text = decode(read_regular(path)[:_MAX_BYTES])
        except (OSError, ValueError) as error:
            reason = getattr(error, "strerror", None) or error
            raise FitError(f"{path}: cannot be read: {reason}") from error
        self.words = [line for line in text.split("\n") if line]
        for line in self.words:
            recording = line.rpartition("=")[0]
            if not recording or Path(recording).name != recording or not (folder / recording).is_file():
                raise FitError(
                    f"{path}: {line[:80]}; expected a recording of {folder} and what was measured, such as "
                    "wall-12.csv=wall@12mm"
                )

    @property
    def words_with_folder(self) -> list[str]:
        """Words with the recordings' full paths, as `fit_inputs` reads them."""
        return [str(self.folder / word) for word in self.words]

    def find_word(self, step: Step) -> str:
        """Return the word of a complete step; empty for another step."""
        return next((word for word in self.words if word.rpartition("=")[0] == step.file_name), "")

    def run(
        self,
        steps: Sequence[Step],
        robot: HostRobot,
        person: Person,
        show: Callable[[str], None],
        stop: Callable[[], bool],
    ) -> bool:
        """Run the steps that are not complete; return False if `stop` returns True.

        Args:
            steps: Steps in order.
            robot: Robot.
            person: Person who places and measures.
            show: Function that shows a line.
            stop: Function that returns whether to stop the session and the motors.

        Raises:
            FitError: A recording cannot be used.
            SensorTestError: A wheel is blocked.
            PortError: The port failed.
        """
        for number, step in enumerate(steps, 1):
            title, word = f"step {number} of {len(steps)}", self.find_word(step)
            if word:
                show(f"{title}: done before: {word}")
            while not word:
                show(f"{title}: {step.kind}")
                distance_mm = person.place(step)
                if distance_mm is None:
                    show(f"{title}: skipped")
                    break
                self._write_words()
                if not record(robot, step, self.folder / step.file_name, stop):
                    return False
                measured = person.measure(step) if step.kind in ("straight", "turns") else distance_mm
                if measured is None:
                    continue  # the person requests another drive
                word = step.make_word(measured)
                # An unusable recording is refused while the robot still stands there.
                fit_inputs([str(self.folder / word)], robot.model)
                self.words.append(word)
                self._write_words()
                show(f"{title}: {word}")
        return True

    def _write_words(self) -> None:
        """Write the words; the file marks the folder as a session's."""
        self.folder.mkdir(parents=True, exist_ok=True)
        write_atomic(self.folder / WORDS_FILE, "".join(f"{word}\n" for word in self.words).encode("utf-8"))
