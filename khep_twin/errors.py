"""The package's errors, one class per kind.

    KhepTwinError
    ├── PlaypenError      a playpen file that cannot be used
    ├── MatError          a MAT file that cannot be read
    ├── BitmapError       a bitmap that cannot become a playpen
    ├── CalibrationError  a calibration file that cannot be used
    ├── ProtocolError     an answer on the serial line that does not fit the command
    ├── PortError         a port that cannot be opened, or that was lost
    │   ├── PortTimeout   a port that stayed silent
    │   └── PortInUse     a port that another program has open
    ├── MoveError         a move that was not completed
    ├── ControllerError   a control program that cannot be found or started
    ├── ChallengeError    a challenge that cannot be used
    ├── LogError          a log that cannot be written or read
    ├── FaultError        a fault to inject that is unknown
    ├── SensorTestError   a sensor test that cannot be run, or unusable data of one
    ├── TurretError       a turret that cannot be plugged on
    ├── StudyError        a study that cannot be used, or results of another study
    ├── SeedError         a seed that is negative or too large; also a ValueError
    ├── StoppedError      a command to a robot whose run is ending
    ├── MissingExtraError a part of khep_twin whose package is not installed
    ├── DeviceError       a device on which episodes cannot run
    ├── SnapshotError     a state of a simulation that cannot be resumed
    └── DivergedError     a simulation that left the bounds of physics

Each message gives the location, its value and the expected one. Programs read them as `file`, `line`, `key`,
`value` and `expected`, and all problems of a file as `problems`. Mistakes of the caller (a wrong type, a
negative time, two threads in one object) stay `TypeError`, `ValueError` and `RuntimeError`.
"""

import builtins
import re
import reprlib
import shlex
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from importlib import metadata
from os import PathLike
from traceback import walk_tb
from typing import Self

Location = tuple[str | int, ...]
"""Tables and keys from the outside in; arrays of tables are followed by a number from 0."""

Expected = str | tuple[object, ...]
"""Expectation in words, or the valid choices."""

PORT_FAILURES = (OSError, ValueError, OverflowError, KeyError)
"""Exceptions of a pyserial port that fails.

A network port refuses a setting by a ValueError; a huge baud rate is an OverflowError, and an unknown value
in a URL a KeyError.
"""


@dataclass(frozen=True, slots=True)
class Problem:
    """Something invalid: its text for users, and its parts for programs.

    Attributes:
        location: Tables and key of the problem; empty for a whole file.
        text: Location, value and expectation.
        value: Value found; None without one.
        expected: Expected value; empty if the text alone has it.
        file: File, as the user named it; None without one.
        line: Line in the file, from 1; None if unknown.
    """

    location: Location
    text: str
    value: object = None
    expected: Expected = ""
    file: str | None = None
    line: int | None = None

    @classmethod
    def of(
        cls, location: Location, text: str, expected: Expected, value: object = None, file: str | None = None
    ) -> Self:
        """Return the problem with the text "text; expected …"."""
        expectation = f"expected {expected}" if isinstance(expected, str) else choices(value, expected)
        return cls(location, text if expected == "" else f"{text}; {expectation}", value, expected, file)

    @property
    def key(self) -> str | None:
        """Key of the problem; None for a whole file or table."""
        *_, last = (None, *(part for part in self.location if part != "[key]"))
        return last if isinstance(last, str) else None

    def __str__(self) -> str:
        """Return the text after the location in the style of compilers: "arena.toml:12: "."""
        if self.file is None:
            return self.text
        return f"{name_text(self.file)}{'' if self.line is None else f':{self.line}'}: {self.text}"


class KhepTwinError(Exception):
    """Root of every error that khep_twin raises for its users.

    Args:
        message: Description of the error, without the arguments that follow; by default "key = value".
        option: Addition for the command line, for example an option that helps.
        file: File with the error, which starts the text.
        key: Key, argument or channel with the error.
        value: Value found.
        expected: Expectation, which ends the text.
        problems: Problems of the error, one line each, instead of the arguments above.

    Attributes:
        plain: Message without `option`.
        problems: Problems as fields; empty if there is only a message.
        file: File of the first problem, as the user named it; None if unknown, like the following.
        line: Line in the file, from 1.
        key: Key, argument or channel.
        value: Value found.
        expected: Expectation in words, or the valid choices.
    """

    def __init__(
        self,
        message: object = "",
        option: str = "",
        *,
        file: str | PathLike[str] | None = None,
        key: str | None = None,
        value: object = None,
        expected: str | Iterable[object] = "",
        problems: Sequence[Problem] = (),
    ) -> None:
        if file is not None or key is not None or expected != "":
            tail = "" if isinstance(expected, str) else ": unknown"
            text = str(message) or f"{key} = {value_text(value)}{tail}"
            expectation = expected if isinstance(expected, str) else tuple(expected)
            file_name = None if file is None else str(file)
            problems = [Problem.of(() if key is None else (key,), text, expectation, value, file_name)]
        self.plain = "\n".join(map(str, problems)) or str(message)
        super().__init__(f"{self.plain}{option}")
        self.problems = tuple(problems)
        first_problem = self.problems[0] if problems else Problem((), "")
        self.file, self.line, self.key = first_problem.file, first_problem.line, first_problem.key
        self.value, self.expected = first_problem.value, first_problem.expected or None


class PlaypenError(KhepTwinError):
    """A playpen file that cannot be used; one line per problem."""


class MatError(KhepTwinError):
    """A MAT file that cannot be read."""


class BitmapError(KhepTwinError):
    """A bitmap that cannot become a playpen."""


class CalibrationError(KhepTwinError):
    """A calibration file that cannot be used."""


class ProtocolError(KhepTwinError):
    """An answer on the serial line that does not fit the command."""


class PortError(KhepTwinError):
    """A port that cannot be opened, or that was lost."""


class PortTimeout(PortError):
    """A port that stayed silent for longer than its timeout."""


class PortInUse(PortError):
    """A port that another program has open."""


class MoveError(KhepTwinError):
    """A move that was not completed."""


class ControllerError(KhepTwinError):
    """A control program that cannot be found or started."""


class ChallengeError(KhepTwinError):
    """A challenge that cannot be used."""


class LogError(KhepTwinError):
    """A log that cannot be written or read."""


class RobotModelError(KhepTwinError):
    """A model of robot that cannot be used."""


class TurretError(KhepTwinError):
    """A turret that cannot be plugged on."""


class StudyError(KhepTwinError):
    """A study that cannot be used, or results of another study."""


class FaultError(KhepTwinError):
    """A fault to inject that is unknown or malformed."""


class FitError(KhepTwinError):
    """Measurements that do not determine the parameters to fit."""


class SensorTestError(KhepTwinError):
    """A sensor test that cannot be run, or unusable data of one."""


class StoppedError(KhepTwinError):
    """A command that would move a robot whose run is ending."""


class MissingExtraError(KhepTwinError):
    """A part of khep_twin whose package is not installed."""

    def __init__(self, package: str, extra: str) -> None:
        super().__init__(f"{package} is not installed; to install it: {pip_install_extra(extra)}")
        self._arguments = package, extra

    def __reduce__(self) -> tuple[type[Self], tuple[str, str]]:
        """Return the constructor and its arguments, for another process."""
        return type(self), self._arguments


class DeviceError(KhepTwinError):
    """A device on which episodes cannot run, for example a missing GPU."""


EXTRAS = {"matplotlib": "pictures", "scipy": "fit"}
"""Extras whose packages are imported where they are requirements, by package."""


class MissingNumbaError(KhepTwinError):
    """A request for compiled code while numba, a dependency of khep_twin, is missing or switched off.

    Args:
        is_off: True if numba is installed but compiles nothing.

    Attributes:
        reason: Reason, without the remedy.
        remedy: Advice to the user.
    """

    def __init__(self, is_off: bool = False) -> None:
        self.is_off = is_off
        self.reason, self.remedy = "numba is not installed", f"to install it: {pip_install_required('numba')}"
        if is_off:
            self.reason, self.remedy = "NUMBA_DISABLE_JIT switches numba off", "expected it unset, or 0"
        super().__init__(f"{self.reason}; {self.remedy}")

    def __reduce__(self) -> tuple[type[Self], tuple[bool]]:
        """Return the constructor and its arguments, for another process."""
        return type(self), (self.is_off,)


class SeedError(KhepTwinError, ValueError):
    """A seed that is negative or too large."""


class SnapshotError(KhepTwinError):
    """A state of a simulation that is damaged, or of another version or scene."""


class DivergedError(KhepTwinError):
    """A simulation that left the bounds of physics."""


def pip_install(*words: str) -> str:
    """Return the command that installs packages for the Python that runs, quoted for a shell."""
    return shlex.join([sys.executable, "-m", "pip", "install", *words])


def pip_install_extra(extra: str) -> str:
    """Return the command that installs the packages of an extra, wherever khep_twin came from."""
    lines = metadata.requires("khep-twin") or []
    requirements = [line.partition(";")[0].strip() for line in lines if f"extra == '{extra}'" in line]
    return pip_install(*requirements)


def pip_install_required(package: str) -> str:
    """Return the command that installs a package that khep_twin requires."""
    requirements = (line for line in metadata.requires("khep-twin") or [] if "extra ==" not in line)
    return pip_install(*(line.partition(";")[0].strip() for line in requirements if line.startswith(package)))


def exception_text(error: BaseException) -> str:
    """Return the type and message of an exception of a user's program in one line."""
    try:
        text = "; ".join(line.strip() for line in str(error).splitlines() if line.strip())
    except Exception as failure:  # `__str__` of a user's exception may fail
        text = f"(its text fails: {type(failure).__name__})"
    return f"{type(error).__name__}: {text}".removesuffix(": ") + _suggest_name(error)


def _suggest_name(error: BaseException) -> str:
    """Return a hint with the name that was probably meant, which Python adds to tracebacks only."""
    name, candidates = getattr(error, "name", None), set[str]()
    if isinstance(error, AttributeError):
        candidates.update(dir(error.obj))
    elif isinstance(error, NameError) and error.__traceback__ is not None:
        *_, (frame, _) = walk_tb(error.__traceback__)
        candidates.update(frame.f_locals, frame.f_globals, dir(builtins))
    matches = get_close_matches(name, sorted(candidates), 1, 0.75) if isinstance(name, str) else []
    return f". Did you mean: {matches[0]!r}?" if matches else ""


class _ShortRepr(reprlib.Repr):
    """Representation of values with few items, and of texts with few characters."""

    def __init__(self) -> None:
        super().__init__()
        self.maxlevel, self.maxstring, self.maxother, self.maxlong = 3, _MAX_VALUE_LENGTH, 120, 60


_MAX_VALUE_LENGTH = 160
"""Largest length of a value in a message [characters]."""


def value_text(value: object) -> str:
    """Return a value as it stands in a message: in one line, shortened if it is long."""
    try:
        text = re.sub(r"\n\s*", " ", _ShortRepr().repr(value))
    except Exception:  # the representation of a user's object may fail, as does that of a huge number
        text = f"<{type(value).__name__}>"
    return text if len(text) <= _MAX_VALUE_LENGTH else f"{text[: _MAX_VALUE_LENGTH - 3]}..."


def name_text(name: object) -> str:
    """Return a file's name for a message: unchanged, or as a value if it is long or not printable."""
    text = str(name)
    return text if text.isprintable() and len(text) <= _MAX_NAME_LENGTH else value_text(text)


_MAX_NAME_LENGTH = 255
"""Largest length of a file's name or path that stands unchanged in a message [characters]."""


NO_TEMPORARY_FOLDER = "no folder for temporary files can be written; expected one, which TMPDIR may name"


def user_error_text(error: BaseException) -> str | None:
    """Return the text of an error that the user or the system causes; None for a fault of the program."""
    if isinstance(error, KhepTwinError):
        return error.plain
    is_folder_missing = isinstance(error, OSError) and "temporary directory" in str(error)
    return NO_TEMPORARY_FOLDER if is_folder_missing else None  # of tempfile, or of Matplotlib


def choices(value: object, valid: Iterable[object]) -> str:
    """Return the tail of a message for an invalid value: the nearest choice, then all choices."""
    names = [str(name) for name in valid]
    try:
        text = str(value)[:_MAX_VALUE_LENGTH]
    except Exception:  # as in `value_text`
        text = ""
    matches = get_close_matches(text, names, n=1)
    hint = f"did you mean {matches[0]!r}? " if matches else ""
    return f"{hint}(choices: {', '.join(names) or 'none'})"
