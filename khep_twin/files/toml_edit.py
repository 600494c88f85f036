"""Editing of a TOML file that changes only the values that differ: comments, order and spaces stay."""

# tomlkit's containers are partly untyped.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false

from collections.abc import Mapping, MutableMapping, Sequence
from difflib import SequenceMatcher
from typing import Any

import tomlkit
from tomlkit.items import AoT

_Table = Mapping[str, Any]
"""Content of a table: tables, arrays and plain values by key."""


def change_table(table: MutableMapping[str, Any], current: _Table, new: _Table, minimal: _Table) -> None:
    """Change a table of a document from `current` to `new`.

    Args:
        table: Table of a tomlkit document; keys that have their defaults may be missing.
        current: Current content, including defaults.
        new: New content, including defaults.
        minimal: New content without defaults, which is written for a new table.
    """
    for key in current:
        if key not in new and key in table:
            del table[key]
    for key, value in new.items():
        old = current.get(key)
        if key in current and old == value:
            continue
        if key in table and isinstance(table[key], AoT) and isinstance(old, list) and isinstance(value, list):
            _change_array(table[key], old, value, minimal[key])
        elif key in table and isinstance(table[key], MutableMapping) and isinstance(value, Mapping):
            change_table(table[key], dict(old or {}), value, minimal.get(key, {}))
        elif isinstance(value, list) and value and all(isinstance(item, Mapping) for item in value):
            table[key] = tomlkit.item([dict(item) for item in minimal[key]])
        elif isinstance(value, Mapping):
            _set_value(table, key, minimal.get(key, value))
        else:
            _set_value(table, key, value)


def _change_array(
    tables: AoT, current: Sequence[_Table], new: Sequence[_Table], minimal: Sequence[_Table]
) -> None:
    """Change an array of tables; unchanged tables keep their comments, also where they move."""
    operations = SequenceMatcher(None, [*map(repr, current)], [*map(repr, new)], autojunk=False).get_opcodes()
    for operation, start, end, new_start, new_end in reversed(operations):
        if operation == "equal":
            continue
        common = min(end - start, new_end - new_start)
        for index, new_index in zip(range(start, start + common), range(new_start, new_end), strict=False):
            change_table(tables[index], current[index], new[new_index], minimal[new_index])
        for index in reversed(range(start + common, end)):
            del tables[index]
        for offset in range(common, new_end - new_start):
            tables.insert(start + offset, tomlkit.item(dict(minimal[new_start + offset])))


def _set_value(table: MutableMapping[str, Any], key: str, value: object) -> None:
    """Set the value of a key; the rest of its line stays."""
    if key in table and hasattr(table[key], "trivia"):
        trivia = table[key].trivia
        item = tomlkit.item(value)
        item.trivia.comment, item.trivia.comment_ws = trivia.comment, trivia.comment_ws
        table[key] = item
    else:
        table[key] = value
