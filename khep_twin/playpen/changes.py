"""Changes of single values of a playpen, e.g. `block.3.x_mm=250`, which moves the third [[block]]."""

import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, cast

from khep_twin.errors import PlaypenError
from khep_twin.files.toml_files import check, freeze
from khep_twin.playpen.checks import placed_parts
from khep_twin.playpen.model import Playpen
from khep_twin.playpen.overlap import placement_problems

_CHANGE = re.compile(r"([a-z_]+)(?:\.([A-Za-z0-9_-]+))?\.([a-z_0-9]+)=(.+)")
_SYNTAX = "TABLE.NUMBER.KEY=VALUE or TABLE.KEY=VALUE, such as block.3.x_mm=250 or lighting.mode=all"


def set_values(playpen: Playpen, changes: Iterable[str]) -> Playpen:
    """Return a playpen with changed values of its file, without a check for collisions.

    Args:
        playpen: Playpen.
        changes: Changes, e.g. `block.3.x_mm=250`; tables of an array are counted from 1.

    Raises:
        PlaypenError: A change is malformed, refers to a missing table, or its value is not allowed.
    """
    data: dict[str, Any] = playpen.model_dump(by_alias=True, exclude_none=True, mode="json")
    for change in changes:
        match = _CHANGE.fullmatch(change)
        if match is None:
            raise PlaypenError(f"{change!r}; expected {_SYNTAX}")
        table, number, key, text = match.groups()
        tables = _tables_by_key(data, table)
        table_key = number or ""
        if table_key not in tables:
            names = list(tables) if tables else [key for key in data if _tables_by_key(data, key)]
            raise PlaypenError(f"{change!r}", key=table, value=table_key if tables else table, expected=names)
        tables[table_key][key] = _parse_value(text)
    return check(
        Playpen, freeze(data), playpen.name, PlaypenError, context={"recorded": True, "placed": False}
    )


def copy_poses(changed: Playpen, current: Playpen, changes: Iterable[str]) -> Playpen:
    """Return a changed playpen with the poses of a current one, except for coordinates that are changed."""
    changed_keys = {parts.groups()[:3] for change in changes if (parts := _CHANGE.fullmatch(change))}

    def with_poses(kind: str) -> tuple[Any, ...]:
        item_pairs = zip(getattr(changed, f"{kind}s"), getattr(current, f"{kind}s"), strict=True)
        return tuple(
            item.model_copy(
                update={
                    key: getattr(current_item, key)
                    for key in ("x_mm", "y_mm", "heading_deg", "angle_deg")
                    if hasattr(item, key) and (kind, str(number), key) not in changed_keys
                }
            )
            for number, (item, current_item) in enumerate(item_pairs, 1)
        )

    return changed.model_copy(update={f"{kind}s": with_poses(kind) for kind in ("robot", *changed.objects)})


def find_new_problem(changed: Playpen, previous: Playpen) -> str:
    """Return the first placement problem of a changed playpen that the previous one does not have."""
    old_problems, new_problems = (
        [problem.text for problem in placement_problems(list(placed_parts(playpen)), playpen.arena)]
        for playpen in (previous, changed)
    )
    return next((text for text in new_problems if text not in old_problems), "")


def changed_tables(changed: Playpen, previous: Playpen) -> dict[str, Sequence[int]]:
    """Return the indices of the robots and objects whose tables differ, by the name of their table."""
    kinds = {"robot": (changed.robots, previous.robots)}
    kinds |= {kind: (items, previous.objects[kind]) for kind, items in changed.objects.items()}
    return {
        kind: [index for index, (new, old) in enumerate(zip(*versions, strict=True)) if new != old]
        for kind, versions in kinds.items()
    }


def _tables_by_key(data: Mapping[str, Any], name: str) -> dict[str, dict[str, Any]]:
    """Return tables by number from 1 for an array; for a table, itself by "" and its subtables by key."""
    content: Any = data.get(name)
    if isinstance(content, list):
        items = cast(list[dict[str, Any]], content)
        return {str(number): table for number, table in enumerate(items, 1)}
    if not isinstance(content, dict):
        return {}
    table = cast(dict[str, Any], content)
    return {"": table, **{key: value for key, value in table.items() if isinstance(value, dict)}}


def _parse_value(text: str) -> object:
    """Return the value of a TOML expression; a bare word is a text."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except (ValueError, RecursionError):
        return text
