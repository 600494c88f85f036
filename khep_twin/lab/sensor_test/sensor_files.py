"""Files of sensor tests: CSV, MAT as in the Khepera Toolbox, and MCAP for rerun.

    .csv    lines "# key: value", then a table with a row for each reading
    .mat    `dv` (n, 10 or 66) and `dlgstr`, as in the toolbox; the settings in further variables
    .mcap   /khepera0/position, and /khepera0/proximity, ambient or vision; the settings as metadata "run"

The same run gives the same bytes. All three formats have all data of a run.
"""

# scipy is not typed.
# pyright: reportMissingTypeStubs=false, reportUnknownVariableType=false, reportUnknownMemberType=false

import re
from collections.abc import Mapping
from itertools import takewhile
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from khep_twin import __version__
from khep_twin.errors import LogError, RobotModelError, SensorTestError
from khep_twin.files.atomic import read_regular, write_atomic
from khep_twin.files.mat_file import mat_bytes
from khep_twin.files.paths import StrPath
from khep_twin.files.text import decode
from khep_twin.lab.sensor_test.sensor_mat import read_mat
from khep_twin.lab.sensor_test.sensor_test import QuantityName, SensorRun, SensorTest, check_quantity
from khep_twin.log.channels import FLOATS, IMAGE, ArrayFrame, ImageFrame
from khep_twin.log.decoding import printable
from khep_twin.log.log_file import LogFile
from khep_twin.log.reader import read_arrays
from khep_twin.robots.model import robot_name
from khep_twin.robots.registry import default_model, find_family

SUFFIXES = (".csv", ".mat", ".mcap")

Number = TypeVar("Number", int, float)

_TITLE = "# khep-twin: sensor test"
_ROBOT = robot_name(0)


def save(path: StrPath, run: SensorRun, replace: bool = True) -> None:
    """Write a run as CSV, MAT or MCAP, by the file's suffix; `replace` as for `write_atomic`.

    Raises:
        SensorTestError: The suffix is unknown, or the run has no rows, or no times for a log.
        KhepTwinError: The file cannot be written.
    """
    path = Path(path)
    kind = check_suffix(path)
    if kind == ".mat" and find_family(run.test.model).family != default_model().family:
        raise SensorTestError(f"{path}: model = {run.test.model!r}; expected .csv or .mcap for it")
    if not len(run.dv):
        raise SensorTestError(f"{path}: the test has no rows; expected a run with rows")
    if kind == ".csv":
        write_atomic(path, _format_csv(run).encode("utf-8"), replace)
    elif kind == ".mat":
        write_atomic(path, _format_mat(run), replace)
    else:
        _write_log(path, run)


def load(path: StrPath, what: QuantityName | None = None) -> SensorRun:
    """Read a run from a file of `save`, or from a MAT file of the Khepera Toolbox.

    `what` is the quantity of a MAT file that does not name it, by default proximity.

    Raises:
        SensorTestError: The file cannot be read, or is not a sensor test.
    """
    path = Path(path)
    kind = check_suffix(path)
    try:
        data = read_regular(path)
    except OSError as error:
        raise SensorTestError(f"{path}: cannot be read: {error.strerror}") from error
    if not data:
        raise SensorTestError(f"{path}: is empty; expected a file with a sensor test")
    try:
        if kind == ".csv":
            return _parse_csv(data)
        return read_mat(data, what) if kind == ".mat" else _read_log(path)
    except (RobotModelError, SensorTestError) as error:
        raise SensorTestError(f"{path}: {error}") from None


def check_suffix(path: Path) -> str:
    """Return a file's suffix in lower case.

    Raises:
        SensorTestError: The suffix is not in `SUFFIXES`.
    """
    if path.suffix.lower() not in SUFFIXES:
        raise SensorTestError(f"{path}; expected a name that ends in .csv, .mat or .mcap")
    return path.suffix.lower()


def facts(test: SensorTest) -> dict[str, str]:
    """Return the settings of a test as texts by key."""
    motion = {"linear_cm": test.linear_cm, "rotate_deg": test.rotate_deg}
    profile = {"speed": test.speed, "acceleration": test.acceleration}
    return {
        "what": test.what,
        "motion": test.motion,
        **{key: repr(float(value)).removesuffix(".0") for key, value in motion.items() if value is not None},
        **{key: str(value) for key, value in profile.items() if value is not None},
        "return_to_zero": str(int(test.return_to_zero)),
        **({} if find_family(test.model).family == default_model().family else {"model": test.model}),
    }


def _parse_test(texts: Mapping[str, str]) -> SensorTest:
    """Return a test from its settings, texts by key."""

    def read_integer(key: str) -> int:
        if key not in texts:
            raise SensorTestError(f"{key}: missing; expected an integer")
        return _number(key, texts[key], int)

    if "what" not in texts:
        raise SensorTestError("what: missing; expected proximity, light or vision")
    quantity = check_quantity(texts["what"])
    linear_cm, rotate_deg = (
        _number(key, texts[key], float) if key in texts else None for key in ("linear_cm", "rotate_deg")
    )
    speed, acceleration, return_to_zero = map(read_integer, ("speed", "acceleration", "return_to_zero"))
    model = texts.get("model", default_model().family)
    test = SensorTest(quantity, linear_cm, rotate_deg, speed, acceleration, bool(return_to_zero), model)
    if texts.get("motion") != test.motion:
        raise SensorTestError(f"motion = {printable(texts.get('motion', ''))}; expected {test.motion} here")
    return test


def _number(name: str, text: str, kind: type[Number]) -> Number:
    try:
        if len(text) > 30:
            raise ValueError
        return kind(text)
    except ValueError:
        expected = "an integer" if kind is int else "a number"
        raise SensorTestError(f"{name} = {text[:40]!r}; expected {expected}") from None


def _columns(test: SensorTest) -> list[str]:
    """Return the names of a table's columns."""
    names = (name.replace(" ", "_") for name in test.quantity.names)
    return ["time_s", "left_pulses", "right_pulses", *names]


def _format_csv(run: SensorRun) -> str:
    head = [_TITLE, *(f"# {key}: {value}" for key, value in facts(run.test).items())]
    head += [f"# text: {line}" for line in run.text.split("\n")]
    data = zip(run.times.tolist(), run.dv.tolist(), strict=True)
    rows = (",".join([repr(time), *map(str, row)]) for time, row in data)
    return "\n".join([*head, ",".join(_columns(run.test)), *rows, ""])


def _parse_csv(data: bytes) -> SensorRun:
    try:
        lines = decode(data).replace("\r\n", "\n").split("\n")
    except ValueError as error:
        raise SensorTestError(str(error)) from None
    if lines[0].rstrip(",;") != _TITLE:
        raise SensorTestError(f"line 1: {lines[0][:40]!r}; expected {_TITLE!r}")
    if lines[-1]:
        raise SensorTestError(f"line {len(lines)}: incomplete; expected a line feed at its end")
    settings: dict[str, str] = {}
    text: list[str] = []
    head = list(takewhile(lambda line: line.startswith("#"), lines[1:]))
    if ";" in lines[0] + lines[1 + len(head)]:
        problem = "fields with ';' between them, as a spreadsheet writes them where numbers have a comma"
        raise SensorTestError(f"line {2 + len(head)}: {problem}; expected ',', and '.' in numbers")
    for number, line in enumerate(head, 2):
        parts = re.fullmatch("# ([a-z_]+): ?(.*)", line, re.DOTALL)
        if parts is None:
            raise SensorTestError(f"line {number}: {line[:40]!r}; expected '# key: value'")
        if parts[1] == "text":
            text.append(parts[2])
        else:
            settings[parts[1]] = parts[2]
    test = _parse_test(settings)
    columns, start = _columns(test), 1 + len(head)
    if lines[start].split(",") != columns:
        raise SensorTestError(f"line {start + 1}: {lines[start][:40]!r}; expected {','.join(columns)}")
    times: list[float] = []
    rows: list[list[int]] = []
    for number, line in enumerate(lines[start + 1 : -1], start + 2):
        fields = line.split(",")
        if len(fields) != len(columns):
            raise SensorTestError(f"line {number}: {len(fields)} fields; expected {len(columns)}")
        times.append(_number(f"line {number}: time_s", fields[0], float))
        counts = zip(columns[1:], fields[1:], strict=True)
        rows.append([_count(f"line {number}: {name}", field) for name, field in counts])
    if not rows:
        raise SensorTestError(f"line {len(lines)}: no rows; expected one for each reading")
    return SensorRun(test, np.array(rows, np.int64), np.array(times, np.float64), "\n".join(text))


def _count(name: str, text: str) -> int:
    if not re.fullmatch("-?[0-9]{1,10}", text):
        raise SensorTestError(f"{name} = {text[:40]!r}; expected an integer")
    return int(text)


def _format_mat(run: SensorRun) -> bytes:
    settings = facts(run.test)
    numbers = {key: float(value) for key, value in settings.items() if key not in ("what", "motion")}
    data = {"dv": run.dv.astype(np.float64), "dlgstr": run.text, "times": run.times.reshape(-1, 1)}
    values: dict[str, object] = {**data, "what": settings["what"], "motion": settings["motion"], **numbers}
    return mat_bytes(values, "sensor test", compressed=False)


def _write_log(path: Path, run: SensorRun) -> None:
    if not np.isfinite(run.times).all():
        raise SensorTestError(f"{path}: the rows have no times, which a log needs; expected .csv or .mat")
    times_ns = np.rint(run.times * 1e9).astype(np.int64)
    log = LogFile(path, lambda: int(times_ns[-1]))
    log.describe({}, {"robots": _ROBOT, "khep_twin": __version__, **facts(run.test), "text": run.text})
    position = ArrayFrame(2, "f8", "left, right [pulses]").messages(run.dv[:, :2])
    log.add_rows(f"/{_ROBOT}/position", FLOATS, times_ns, position)
    topic, readings = f"/{_ROBOT}/{run.test.quantity.topic}", run.dv[:, 2:]
    if run.test.what == "vision":
        images = ImageFrame(readings.shape[1], f"{_ROBOT}/k213").messages(times_ns, readings)
        log.add_rows(topic, IMAGE, times_ns, images)
    else:
        counts = ArrayFrame(readings.shape[1], "f8", "counts").messages(readings)
        log.add_rows(topic, FLOATS, times_ns, counts)
    log.finish()


def _read_log(path: Path) -> SensorRun:
    try:
        label, arrays = read_arrays(path)
    except LogError as error:
        raise SensorTestError(str(error).removeprefix(f"{path}: ")) from error
    if "what" not in label.metadata:
        raise SensorTestError("not a log of a sensor test; expected one that khep-twin sense has written")
    test = _parse_test(label.metadata)
    parts: list[NDArray[np.int64]] = []
    times: list[NDArray[np.int64]] = []
    for name, width in (("position", 2), (test.quantity.topic, len(test.quantity.names))):
        topic = f"/{_ROBOT}/{name}"
        if topic not in arrays or arrays[topic][1].shape[1] != width:
            raise SensorTestError(f"{topic}: missing; expected messages of {width} values")
        times.append(arrays[topic][0])
        values = arrays[topic][1]
        if (invalid := values[~((np.abs(values) < 2**31) & (values == np.round(values)))]).size:
            raise SensorTestError(f"{topic}: {invalid[0]:g}; expected integers")
        parts.append(values.astype(np.int64))
    if not np.array_equal(times[0], times[1]):
        raise SensorTestError("positions and readings differ in time; expected one of each for every reading")
    return SensorRun(test, np.hstack(parts), times[0] / 1e9, label.metadata.get("text", ""))
