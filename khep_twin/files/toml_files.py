"""Strict reading of hand-written TOML files: playpens and calibrations.

A file is checked against a pydantic model, and every problem becomes one line that names the file, its line,
the table, the key, the value found and what was expected:

    arena.toml:12: block 2: heigth_mm = 50: unknown key; did you mean 'height_mm'? (choices: ...)
"""

import re
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from importlib.resources import files
from itertools import islice
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, Literal, TypeVar, cast, get_args, get_origin

import tomlkit
from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import ErrorDetails

from khep_twin.errors import Expected, KhepTwinError, Location, Problem, choices
from khep_twin.files.atomic import open_regular
from khep_twin.files.text import decode
from khep_twin.files.toml_edit import change
from khep_twin.files.toml_lines import LineNumbers
from khep_twin.invocation import command

SIZE_LIMIT = 2**20
"""Largest file that is read [bytes]."""

PROBLEM_LIMIT = 50
"""Most problems of a file that are reported at once."""

NAME_WISH = "1 to 64 letters, digits, '_' or '-'"
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{1,64}$")]

Model = TypeVar("Model", bound="TomlTable")

# As tomllib and pydantic have it: its values are tables, arrays and plain values.
Table = dict[str, Any]

# A key of thousands of parts takes tomllib seconds and ends in a RecursionError.
_DEEP_KEY = re.compile(r"""(?<![\w-])(?:(?:[\w-]++|"[^"\n]*"|'[^'\n]*')[ \t]*+\.[ \t]*+){32}""")


class Problems(ValueError):
    """Problems found by a model's own checks."""

    def __init__(self, problems: Sequence[Problem]) -> None:
        super().__init__("\n".join(problem.text for problem in problems))
        self.problems = problems


class TomlTable(BaseModel):
    """A table of a file: no unknown keys, no conversion, no infinite numbers, immutable."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", strict=True, allow_inf_nan=False, populate_by_name=False
    )


def folder(kind: str) -> Path:
    """Return the folder of the shipped files of a kind: "playpens" or "calibration"."""
    return Path(str(files("khep_twin"))) / "assets" / kind


def names(kind: str) -> list[str]:
    """Return the bare names of the shipped files of a kind."""
    return sorted(path.stem for path in folder(kind).glob("*.toml"))


def summary(kind: str, name: str) -> str:
    """Return the first sentence of a shipped file, in its first line."""
    with (folder(kind) / f"{name}.toml").open(encoding="utf-8") as file:
        return file.readline().removeprefix("# ").strip().partition(". ")[0].removesuffix(".")


def read(kind: str, name: str | Path, error: type[KhepTwinError]) -> tuple[str, str]:
    """Return the text of a file given by bare name or path, and its name in messages.

    Raises:
        error: The file does not exist, is too large, or is not text.
    """
    path = folder(kind) / f"{name}.toml" if str(name) in names(kind) else Path(name)
    source = str(name)
    try:
        with open_regular(path) as file:
            data = file.read(SIZE_LIMIT + 1)
    except FileNotFoundError:
        wanted = f"the path of a file or a shipped name; {choices(name, names(kind))}"
        raise error("no such file", file=source, expected=wanted) from None
    except (OSError, ValueError) as trouble:
        reason = trouble.strerror if isinstance(trouble, OSError) else trouble
        raise error(f"cannot be read: {reason}", file=source) from None
    if len(data) > SIZE_LIMIT:
        raise error(f"larger than {SIZE_LIMIT} bytes, the most that is read", file=source)
    try:
        return decode(data), source
    except ValueError as trouble:
        raise error(str(trouble), file=source) from None


def validate(
    model: type[Model],
    text: str,
    source: str,
    error: type[KhepTwinError],
    context: Mapping[str, object] | None = None,
) -> Model:
    """Validate the text of a file as `model`; `context` is passed to its validators.

    Raises:
        error: The text is no TOML, or does not fit the model; one line per problem.
    """
    if _DEEP_KEY.search(text):
        raise error("a key has more than 32 parts", file=source)
    try:
        data = frozen(tomllib.loads(text))
    except tomllib.TOMLDecodeError as trouble:
        run = f"; to run a controller: {command('run', source)}" if source.endswith(".py") else ""
        raise error(f"not TOML: {trouble}", run, file=source) from None
    except ValueError:
        raise error("not TOML that can be read: a number has thousands of digits", file=source) from None
    except RecursionError:
        raise error("not TOML that can be read: nested too deeply", file=source) from None
    return check(model, data, source, error, text, context)


def check(
    model: type[Model],
    data: Mapping[str, object],
    source: str,
    error: type[KhepTwinError],
    text: str = "",
    context: Mapping[str, object] | None = None,
) -> Model:
    """Check the tables of a file, arrays as tuples, against `model`; its text gives the line numbers.

    Raises:
        error: They do not fit the model; one line per problem.
    """
    try:
        return model.model_validate(data, context=context)
    except ValidationError as trouble:
        problems = list(islice(_problems(model, trouble, data), PROBLEM_LIMIT + 1))
        if len(problems) > PROBLEM_LIMIT:
            last = f"more than {PROBLEM_LIMIT} problems; the others are reported once these are gone"
            problems[-1] = Problem((), last)
        lines = LineNumbers(text)
        raise error(
            problems=[replace(each, file=source, line=lines.of(each.location)) for each in problems]
        ) from None


def problems(model: type[Model], data: Mapping[str, object]) -> list[Problem]:
    """Return the problems of data as `model`, as reported by `check`; empty if there are none."""
    try:
        model.model_validate(data := frozen(data))
    except ValidationError as trouble:
        return list(islice(_problems(model, trouble, data), PROBLEM_LIMIT))
    return []


def frozen(table: Mapping[str, object]) -> dict[str, object]:
    """Return data with its arrays as tuples, as required by strict models."""
    return {key: _frozen(value) for key, value in table.items()}


def _frozen(value: object) -> object:
    if isinstance(value, dict):
        return frozen(cast(dict[str, object], value))
    return tuple(map(_frozen, cast(list[object], value))) if isinstance(value, list) else value


def dump(table: TomlTable) -> str:
    """Return a table as the text of a file, every key written out; reading it back gives the same table."""
    return tomlkit.dumps(_plain_data(table))


def edited(
    text: str,
    before: TomlTable,
    after: TomlTable,
    said: Callable[[Table, Table], Table] = lambda before, _: before,
    bare: Callable[[Table], Table] = lambda after: after,
) -> str:
    """Return the text of a file, changed from `before` to `after`; comments and all else stay.

    Keys of a new table that have their defaults are left out.

    Args:
        text: Text of the file.
        before: Current content.
        after: New content.
        said: Function of both as data that returns the part of `before` which the file states itself.
        bare: Function of `after` without defaults that returns it without what follows from other keys.
    """
    if before == after:
        return text
    document = tomlkit.parse(text if text.endswith("\n") else text + "\n")
    old, new = _plain_data(before), _plain_data(after)
    change(document, said(old, new), new, bare(_plain_data(after, exclude_defaults=True)))
    return tomlkit.dumps(document)


def schema(model: type[TomlTable]) -> Table:
    """Return the JSON schema of a model's files."""
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        **model.model_json_schema(by_alias=True),
    }


def show(value: object) -> str:
    """Return a value as in messages: short, and as TOML writes it."""
    if isinstance(value, bool):
        return str(value).lower()
    return _plain(f'"{value}"' if isinstance(value, str) else _text(value))


def _text(value: object) -> str:
    """Return a value as text; Python refuses to print an integer of thousands of digits."""
    try:
        return str(value)
    except ValueError:
        return "a number of thousands of digits"


def _plain(text: str) -> str:
    """Return text without control characters, and not too long for a line."""
    text = "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)
    return text if len(text) <= 60 else text[:57] + "..."


def _plain_data(table: TomlTable, *, exclude_defaults: bool = False) -> Table:
    return table.model_dump(by_alias=True, exclude_none=True, exclude_defaults=exclude_defaults, mode="json")


def _problems(model: type[BaseModel], trouble: ValidationError, data: Mapping[str, Any]) -> Iterator[Problem]:
    for problem in trouble.errors(include_url=False):
        location = problem["loc"]
        if problem["type"] == "value_error" and not location:
            # A model's own checks of the whole name their places themselves.
            found = problem.get("ctx", {})["error"]
            problems = found.problems if isinstance(found, Problems) else [Problem((), str(found))]
            yield from (replace(each, value=each.value or _value(data, each.location)) for each in problems)
        else:
            place, key = _place(location)
            reason, expected = _reason(model, location, key, problem)
            yield Problem(location, f"{place}{reason}", _value(data, location), expected)


def _value(data: Any, location: Location) -> Any:
    """Return the value at a location; None for a whole table or without one."""
    for part in location:
        try:
            data = data[part]
        except (LookupError, TypeError):
            return None
    return None if isinstance(data, Mapping) else data


def _place(location: Sequence[str | int]) -> tuple[str, str]:
    """Return table and key of a location, e.g. ("block 2: ", "height_mm")."""
    words: list[str] = []
    for part in location:
        if isinstance(part, int) and words:
            words[-1] += f" {part + 1}"
        elif part != "[key]":
            words.append(_plain(str(part)))
    *tables, key = words
    return " ".join(tables) + (": " if tables else ""), key


def _reason(
    model: type[BaseModel], location: Location, key: str, problem: ErrorDetails
) -> tuple[str, Expected]:
    """Return the text of a problem, and what was expected."""
    kind = problem["type"]
    field, keys = _field(model, location)
    if kind == "missing":
        return f"{key} is missing; expected {(wanted := _expected(field))}", wanted
    if location[-1] == "[key]":
        return f"{show(key)} is no name; expected {NAME_WISH}", NAME_WISH
    given = _given(key, problem["input"])
    if kind == "extra_forbidden":
        return f"{given}: unknown key; {choices(key, keys)}", tuple(keys)
    if kind == "literal_error" and field is not None:
        literals = _literals(field.annotation)
        return f"{given}: unknown; {choices(_text(problem['input']), literals)}", tuple(literals)
    return f"{given}; expected {(wanted := _expected(field))}", wanted


def _given(key: str, value: object) -> str:
    return key if isinstance(value, dict | tuple) else f"{key} = {show(value)}"


def _field(model: type[BaseModel], location: Sequence[str | int]) -> tuple[FieldInfo | None, list[str]]:
    """Return the field at a location, and the keys of its table."""
    table: type[BaseModel] | None = model
    field: FieldInfo | None = None
    keys: list[str] = []
    for part in location:
        if isinstance(part, int) or table is None:
            continue
        fields = {(each.alias or name): each for name, each in table.model_fields.items()}
        keys = list(fields)
        # A free key, such as a surface's name, belongs to the field around it.
        if part in fields:
            field = fields[part]
            table = _table_of(field.annotation)
    return field, keys


def _table_of(annotation: object) -> type[BaseModel] | None:
    """Return the table within an annotation such as tuple[Block, ...] or dict[str, Surface]."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next((table for part in get_args(annotation) if (table := _table_of(part)) is not None), None)


def _literals(annotation: object) -> list[object]:
    if get_origin(annotation) is Literal:
        return list(get_args(annotation))
    return [literal for part in get_args(annotation) for literal in _literals(part)]


def _expected(field: FieldInfo | None) -> str:
    """Return what a field accepts, in words."""
    if field is None:
        return "a key of this table"
    if field.description:
        return field.description
    annotation = _given_type(field.annotation)
    if literals := _literals(annotation):
        return " or ".join(show(literal) for literal in literals)
    if annotation is int or annotation is float:
        word = "an integer" if annotation is int else "a number"
        return f"{word} {_range(field)}".rstrip()
    if annotation is bool:
        return "true or false"
    if annotation is str:
        return NAME_WISH if any(hasattr(rule, "pattern") for rule in field.metadata) else "text"
    if get_origin(annotation) is tuple:
        return f"[[{field.alias}]], in two brackets each" if _table_of(annotation) else "a list of values"
    return "a table"


def _given_type(annotation: object) -> object:
    """Return the type of an optional key's value: `float` of `float | None`."""
    parts = [part for part in get_args(annotation) if part is not NoneType]
    return parts[0] if len(parts) == 1 and NoneType in get_args(annotation) else annotation


def _range(field: FieldInfo) -> str:
    """Return a number's limits, e.g. "from 0 to 2", "above 0 up to 1000"."""
    keys = ("gt", "ge", "le")
    limits = {key: getattr(rule, key) for rule in field.metadata for key in keys if hasattr(rule, key)}
    words = {"gt": "above", "ge": "from", "le": "to" if "ge" in limits else "up to"}
    return " ".join(f"{words[key]} {limits[key]:g}" for key in keys if key in limits)
