"""Strict reading of hand-written TOML files: playpens and calibrations.

A file is checked against a pydantic model. Each problem becomes one line with the name of the file, the line
number, the table, the key, its value and the expected values:

    arena.toml:12: block 2: heigth_mm = 50: unknown key; did you mean 'height_mm'? (choices: ...)
"""

import re
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.resources import files
from itertools import islice
from pathlib import Path
from types import NoneType
from typing import Annotated, Any, Literal, TypeVar, cast, get_args, get_origin

import tomlkit
from pydantic import BaseModel, ConfigDict, Field, GetCoreSchemaHandler, GetJsonSchemaHandler, ValidationError
from pydantic.fields import FieldInfo
from pydantic_core import CoreSchema, ErrorDetails, PydanticCustomError, core_schema

from khep_twin.errors import Expected, KhepTwinError, Location, Problem, choices
from khep_twin.files.atomic import open_regular
from khep_twin.files.text import decode
from khep_twin.files.toml_edit import change_table
from khep_twin.files.toml_lines import LineNumbers
from khep_twin.process.invocation import command

SIZE_LIMIT = 2**20
"""Largest file that is read [bytes]."""

PROBLEM_LIMIT = 50
"""Most problems of a file that are reported together."""

NAME_RULE = "1 to 64 letters, digits, '_' or '-'"
Name = Annotated[str, Field(pattern=r"^[A-Za-z0-9_-]{1,64}$")]

Model = TypeVar("Model", bound="TomlTable")

# Content of a table as of tomllib and pydantic: tables, arrays and plain values by key.
Table = dict[str, Any]

# tomllib takes seconds for a key of thousands of parts, and raises a RecursionError.
_DEEP_KEY = re.compile(r"""(?<![\w-])(?:(?:[\w-]++|"[^"\n]*"|'[^'\n]*')[ \t]*+\.[ \t]*+){32}""")


class Problems(ValueError):
    """Problems found by the validators of a model."""

    def __init__(self, problems: Sequence[Problem]) -> None:
        super().__init__("\n".join(problem.text for problem in problems))
        self.problems = problems


class TomlTable(BaseModel):
    """A table of a file: immutable, without unknown keys, conversions and infinite numbers."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", strict=True, allow_inf_nan=False, populate_by_name=False
    )


@dataclass(frozen=True, slots=True)
class OneOf:
    """Constraint of a text: one of the names that are known when a file is read.

    Attributes:
        names: Function that returns the names.
    """

    names: Callable[[], Iterable[str]]

    def __get_pydantic_core_schema__(self, source: object, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.no_info_after_validator_function(self._check, handler(source))

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> Table:
        return {**handler(schema), "enum": [*self.names()]}

    def _check(self, name: str) -> str:
        if name not in self.names():
            raise PydanticCustomError("literal_error", "unknown")
        return name


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


def path_of(kind: str, name: str | Path, paths: Mapping[str, str] = {}) -> Path:
    """Return the path of a file given by bare name or path; `paths` are those of further bare names."""
    source = str(name)
    return folder(kind) / f"{source}.toml" if source in names(kind) else Path(paths.get(source, name))


def read(
    kind: str, name: str | Path, error_type: type[KhepTwinError], paths: Mapping[str, str] = {}
) -> tuple[str, str]:
    """Return the text of a file given by bare name or path, and its name in messages.

    `paths` are those of files with bare names elsewhere.

    Raises:
        error_type: The file does not exist, exceeds the size limit, or is not text.
    """
    source = str(name)
    try:
        with open_regular(path_of(kind, name, paths)) as file:
            data = file.read(SIZE_LIMIT + 1)
    except FileNotFoundError:
        expected = "the path of a file"
        if shipped_names := [*dict.fromkeys((*names(kind), *paths))]:
            expected += f" or a shipped name; {choices(name, shipped_names)}"
        raise error_type("no such file", file=source, expected=expected) from None
    except OSError as error:
        raise error_type(f"cannot be read: {error.strerror}", file=source) from None
    if len(data) > SIZE_LIMIT:
        raise error_type(f"larger than {SIZE_LIMIT} bytes, the most that is read", file=source)
    try:
        return decode(data), source
    except ValueError as error:
        raise error_type(str(error), file=source) from None


def validate(
    model: type[Model],
    text: str,
    source: str,
    error_type: type[KhepTwinError],
    context: Mapping[str, object] | None = None,
) -> Model:
    """Validate the text of a file as `model`; `context` is passed to its validators.

    Raises:
        error_type: The text is no TOML, or does not fit the model; one line per problem.
    """
    return check(model, parse(text, source, error_type), source, error_type, text, context)


def parse(text: str, source: str, error_type: type[KhepTwinError]) -> Table:
    """Return the tables of a file, with arrays as tuples.

    Raises:
        error_type: The text is no TOML.
    """
    if _DEEP_KEY.search(text):
        raise error_type("a key has more than 32 parts", file=source)
    try:
        return freeze(tomllib.loads(text))
    except tomllib.TOMLDecodeError as error:
        hint = f"; to run a controller: {command('run', source)}" if source.endswith(".py") else ""
        raise error_type(f"not TOML: {error}", hint, file=source) from None
    except ValueError:
        raise error_type("not TOML that can be read: a number has thousands of digits", file=source) from None
    except RecursionError:
        raise error_type("not TOML that can be read: nested too deeply", file=source) from None


def check(
    model: type[Model],
    data: Mapping[str, object],
    source: str,
    error_type: type[KhepTwinError],
    text: str = "",
    context: Mapping[str, object] | None = None,
) -> Model:
    """Check the tables of a file, with arrays as tuples, against `model`; `text` gives the line numbers.

    Raises:
        error_type: They do not fit the model; one line per problem.
    """
    try:
        return model.model_validate(data, context=context)
    except ValidationError as error:
        problems = list(islice(_problems(model, error, data), PROBLEM_LIMIT + 1))
        if len(problems) > PROBLEM_LIMIT:
            message = f"more than {PROBLEM_LIMIT} problems; the others are reported once these are gone"
            problems[-1] = Problem((), message)
        lines = LineNumbers(text)
        raise error_type(
            problems=[replace(item, file=source, line=lines.find(item.location)) for item in problems]
        ) from None


def problems(model: type[Model], data: Mapping[str, object]) -> list[Problem]:
    """Return the problems that `check` reports of data; empty if there are none."""
    try:
        model.model_validate(data := freeze(data))
    except ValidationError as error:
        return list(islice(_problems(model, error, data), PROBLEM_LIMIT))
    return []


def freeze(table: Mapping[str, object]) -> dict[str, object]:
    """Return data with arrays as tuples, which strict models require."""
    return {key: _freeze_value(value) for key, value in table.items()}


def _freeze_value(value: object) -> object:
    if isinstance(value, dict):
        return freeze(cast(dict[str, object], value))
    return tuple(map(_freeze_value, cast(list[object], value))) if isinstance(value, list) else value


def dump(table: TomlTable) -> str:
    """Return a table as the text of a file with all keys; reading it gives the same table."""
    return tomlkit.dumps(_to_data(table))


def edit(
    text: str,
    current: TomlTable,
    new: TomlTable,
    select_stated: Callable[[Table, Table], Table] = lambda current, _: current,
    drop_derived: Callable[[Table], Table] = lambda new: new,
) -> str:
    """Return the text of a file, changed from `current` to `new`; comments and other keys stay.

    New tables are written without keys that have their default values.

    Args:
        text: Text of the file.
        current: Current content.
        new: New content.
        select_stated: Function of both as data; returns the part of `current` that the file states.
        drop_derived: Function of the new data without defaults; removes keys that follow from others.
    """
    if current == new:
        return text
    document = tomlkit.parse(text if text.endswith("\n") else text + "\n")
    old_data, new_data = _to_data(current), _to_data(new)
    minimal = drop_derived(_to_data(new, exclude_defaults=True))
    change_table(document, select_stated(old_data, new_data), new_data, minimal)
    return tomlkit.dumps(document)


def schema(model: type[TomlTable]) -> Table:
    """Return the JSON schema of a model's files."""
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        **model.model_json_schema(by_alias=True),
    }


def format_value(value: object) -> str:
    """Return a value for messages: in TOML, shortened."""
    if isinstance(value, bool):
        return str(value).lower()
    return _printable(f'"{value}"' if isinstance(value, str) else _to_text(value))


def _to_text(value: object) -> str:
    """Return a value as text, though Python refuses to print an integer of thousands of digits."""
    try:
        return str(value)
    except ValueError:
        return "a number of thousands of digits"


def _printable(text: str) -> str:
    """Return text without control characters, shortened to 60 characters."""
    text = "".join(c if c.isprintable() else c.encode("unicode_escape").decode("ascii") for c in text)
    return text if len(text) <= 60 else text[:57] + "..."


def _to_data(table: TomlTable, *, exclude_defaults: bool = False) -> Table:
    return table.model_dump(by_alias=True, exclude_none=True, exclude_defaults=exclude_defaults, mode="json")


def _problems(model: type[BaseModel], error: ValidationError, data: Mapping[str, Any]) -> Iterator[Problem]:
    for problem in error.errors(include_url=False):
        location = problem["loc"]
        min_length: int = problem.get("ctx", {}).get("min_length", 0)
        if problem["type"] == "too_short" and len(problem["input"]) >= min_length:
            continue  # pydantic does not count wrong values, which are problems themselves
        if problem["type"] == "value_error" and not location:
            # A model's validator includes the locations in its messages.
            cause = problem.get("ctx", {})["error"]
            problems = cause.problems if isinstance(cause, Problems) else [Problem((), str(cause))]
            yield from (replace(item, value=item.value or _lookup(data, item.location)) for item in problems)
        else:
            table_prefix, key = _table_and_key(location)
            reason, expected = _describe_problem(model, location, key, problem)
            yield Problem(location, f"{table_prefix}{reason}", _lookup(data, location), expected)


def _lookup(data: Any, location: Location) -> Any:
    """Return the value at a location; None for a whole table or without one."""
    for key in location:
        try:
            data = data[key]
        except (LookupError, TypeError):
            return None
    return None if isinstance(data, Mapping) else data


def _table_and_key(location: Sequence[str | int]) -> tuple[str, str]:
    """Return table and key of a location, e.g. ("block 2: ", "height_mm")."""
    words: list[str] = []
    for part in location:
        if isinstance(part, int) and words:
            words[-1] += f" {part + 1}"
        elif part != "[key]":
            words.append(_printable(str(part)))
    *tables, key = words
    return " ".join(tables) + (": " if tables else ""), key


def _describe_problem(
    model: type[BaseModel], location: Location, key: str, problem: ErrorDetails
) -> tuple[str, Expected]:
    """Return the text of a problem, and the expected values."""
    kind = problem["type"]
    field, keys = _field_at(model, location)
    if kind == "missing":
        return f"{key} is missing; expected {(expected := _describe_expected(field))}", expected
    if location[-1] == "[key]":
        return f"{format_value(key)} is no name; expected {NAME_RULE}", NAME_RULE
    value = problem["input"]
    assignment = key if isinstance(value, dict | tuple) else f"{key} = {format_value(value)}"
    if kind == "extra_forbidden":
        return f"{assignment}: unknown key; {choices(key, keys)}", tuple(keys)
    if kind in ("literal_error", "string_type") and field is not None and (literals := choices_of(field)):
        return f"{assignment}: unknown; {choices(_to_text(problem['input']), literals)}", tuple(literals)
    return f"{assignment}; expected {(expected := _describe_expected(field))}", expected


def _field_at(model: type[BaseModel], location: Sequence[str | int]) -> tuple[FieldInfo | None, list[str]]:
    """Return the field at a location, and the keys of its table."""
    table: type[BaseModel] | None = model
    field: FieldInfo | None = None
    keys: list[str] = []
    for part in location:
        if isinstance(part, int) or table is None:
            continue
        fields = {(info.alias or name): info for name, info in table.model_fields.items()}
        keys = list(fields)
        # The name of a surface is no field; it belongs to the field `surfaces`.
        if part in fields:
            field = fields[part]
            table = _table_in(field.annotation)
    return field, keys


def _table_in(annotation: object) -> type[BaseModel] | None:
    """Return the table in an annotation, e.g. tuple[Block, ...] or dict[str, Surface]."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    return next((table for part in get_args(annotation) if (table := _table_in(part)) is not None), None)


def choices_of(field: FieldInfo) -> list[object]:
    """Return the values of a field that has a fixed set, by a `Literal` or `OneOf`; empty for others."""
    names: list[object] = [
        name for rule in field.metadata if isinstance(rule, OneOf) for name in rule.names()
    ]
    return names or _literals_in(field.annotation)


def _literals_in(annotation: object) -> list[object]:
    if get_origin(annotation) is Literal:
        return list(get_args(annotation))
    return [literal for part in get_args(annotation) for literal in _literals_in(part)]


def _describe_expected(field: FieldInfo | None) -> str:
    """Return a description of the values that a field accepts."""
    if field is None:
        return "a key of this table"
    if field.description:
        return field.description
    annotation = _required_type(field.annotation)
    if literals := choices_of(field):
        return " or ".join(format_value(literal) for literal in literals)
    if annotation is int or annotation is float:
        word = "an integer" if annotation is int else "a number"
        return f"{word} {_describe_range(field)}".rstrip()
    if annotation is bool:
        return "true or false"
    if annotation is str:
        return NAME_RULE if any(hasattr(rule, "pattern") for rule in field.metadata) else "text"
    if get_origin(annotation) is tuple:
        return f"[[{field.alias}]], in two brackets each" if _table_in(annotation) else "a list of values"
    return "a table"


def _required_type(annotation: object) -> object:
    """Return the type of an optional value: `float` for `float | None`."""
    parts = [part for part in get_args(annotation) if part is not NoneType]
    return parts[0] if len(parts) == 1 and NoneType in get_args(annotation) else annotation


def _describe_range(field: FieldInfo) -> str:
    """Return a number's limits, e.g. "from 0 to 2", "above 0 up to 1000"."""
    keys = ("gt", "ge", "le")
    limits = {key: getattr(rule, key) for rule in field.metadata for key in keys if hasattr(rule, key)}
    words = {"gt": "above", "ge": "from", "le": "to" if "ge" in limits else "up to"}
    return " ".join(f"{words[key]} {limits[key]:g}" for key in keys if key in limits)
