"""Editing of a TOML file that changes only what differs: comments, order and spaces stay."""

# tomlkit's containers are partly untyped.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false

from collections.abc import Mapping, MutableMapping, Sequence
from difflib import SequenceMatcher
from typing import Any

import tomlkit
from tomlkit.items import AoT

_Table = Mapping[str, Any]
"""Content of a table: its values are tables, arrays and plain values."""


def change(table: MutableMapping[str, Any], before: _Table, after: _Table, bare: _Table) -> None:
    """Change a table of a document from `before` to `after`.

    Args:
        table: Table of a tomlkit document; keys that have their defaults may be missing.
        before: Current content, defaults included.
        after: New content, defaults included.
        bare: New content without defaults, as written for a new table.
    """
    for key in before:
        if key not in after and key in table:
            del table[key]
    for key, value in after.items():
        old = before.get(key)
        if key in before and old == value:
            continue
        if key in table and isinstance(table[key], AoT) and isinstance(old, list) and isinstance(value, list):
            _change_list(table[key], old, value, bare[key])
        elif key in table and isinstance(table[key], MutableMapping) and isinstance(value, Mapping):
            change(table[key], dict(old or {}), value, bare.get(key, {}))
        elif isinstance(value, list) and value and all(isinstance(item, Mapping) for item in value):
            table[key] = tomlkit.item([dict(each) for each in bare[key]])
        elif isinstance(value, Mapping):
            _set(table, key, bare.get(key, value))
        else:
            _set(table, key, value)


def _change_list(
    tables: AoT, before: Sequence[_Table], after: Sequence[_Table], bare: Sequence[_Table]
) -> None:
    """Change an array of tables; those that stay keep their comments wherever they move to."""
    steps = SequenceMatcher(None, [*map(repr, before)], [*map(repr, after)], autojunk=False).get_opcodes()
    for kind, start, end, first, last in reversed(steps):
        if kind == "equal":
            continue
        common = min(end - start, last - first)
        for offset in range(common):
            change(
                tables[start + offset], before[start + offset], after[first + offset], bare[first + offset]
            )
        for index in reversed(range(start + common, end)):
            del tables[index]
        for offset in range(common, last - first):
            tables.insert(start + offset, tomlkit.item(dict(bare[first + offset])))


def _set(table: MutableMapping[str, Any], key: str, value: object) -> None:
    """Set the value of a key; the rest of its line stays."""
    if key in table and hasattr(table[key], "trivia"):
        trivia = table[key].trivia
        item = tomlkit.item(value)
        item.trivia.comment, item.trivia.comment_ws = trivia.comment, trivia.comment_ws
        table[key] = item
    else:
        table[key] = value
