"""Changes of single values of a playpen, such as `block.3.x_mm=250`: the third [[block]] stands elsewhere."""

import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, cast

from khep_twin.errors import PlaypenError
from khep_twin.files.toml_files import check, frozen
from khep_twin.playpen.checks import things
from khep_twin.playpen.model import Playpen
from khep_twin.playpen.overlap import placement_problems

_CHANGE = re.compile(r"([a-z_]+)(?:\.([A-Za-z0-9_-]+))?\.([a-z_0-9]+)=(.+)")
_WISH = "TABLE.NUMBER.KEY=VALUE or TABLE.KEY=VALUE, such as block.3.x_mm=250 or lighting.mode=all"


def set_values(playpen: Playpen, changes: Iterable[str]) -> Playpen:
    """Return a playpen with other values, as in its file; whether all have room is not checked.

    Args:
        playpen: Playpen.
        changes: Changes such as `block.3.x_mm=250`, tables of an array being counted from 1 as in messages.

    Raises:
        PlaypenError: A change is malformed, names what is not there, or gives a value that is not allowed.
    """
    data: dict[str, Any] = playpen.model_dump(by_alias=True, exclude_none=True, mode="json")
    for change in changes:
        parts = _CHANGE.fullmatch(change)
        if parts is None:
            raise PlaypenError(f"{change!r}; expected {_WISH}")
        table, number, key, text = parts.groups()
        tables = _tables(data, table)
        place = number or ""
        if place not in tables:
            known = list(tables) if tables else [key for key in data if _tables(data, key)]
            raise PlaypenError(f"{change!r}", key=table, value=place if tables else table, expected=known)
        tables[place][key] = _value(text)
    return check(
        Playpen, frozen(data), playpen.name, PlaypenError, context={"recorded": True, "placed": False}
    )


def posed(changed: Playpen, stands: Playpen, changes: Iterable[str]) -> Playpen:
    """Return a changed playpen whose robots and objects stand as in another one, but where a change says."""
    set_there = {parts.groups()[:3] for change in changes if (parts := _CHANGE.fullmatch(change))}

    def at(kind: str) -> tuple[Any, ...]:
        pairs = zip(getattr(changed, f"{kind}s"), getattr(stands, f"{kind}s"), strict=True)
        return tuple(
            item.model_copy(
                update={
                    key: getattr(standing, key)
                    for key in ("x_mm", "y_mm", "heading_deg", "angle_deg")
                    if hasattr(item, key) and (kind, str(number), key) not in set_there
                }
            )
            for number, (item, standing) in enumerate(pairs, 1)
        )

    return changed.model_copy(update={f"{kind}s": at(kind) for kind in ("robot", *changed.objects)})


def no_room_for(changed: Playpen, before: Playpen) -> str:
    """Return the first reason why a changed playpen's things do not have room that the one before lacks."""
    known, new = (
        [problem.text for problem in placement_problems(list(things(each)), each.arena)]
        for each in (before, changed)
    )
    return next((text for text in new if text not in known), "")


def changed_tables(changed: Playpen, before: Playpen) -> dict[str, Sequence[int]]:
    """Return the indices of the robots and objects whose tables differ, by the name of their table."""
    kinds = {"robot": (changed.robots, before.robots)}
    kinds |= {kind: (items, before.objects[kind]) for kind, items in changed.objects.items()}
    return {
        kind: [place for place, (new, old) in enumerate(zip(*both, strict=True)) if new != old]
        for kind, both in kinds.items()
    }


def _tables(data: Mapping[str, Any], name: str) -> dict[str, dict[str, Any]]:
    """Return the tables of a name: those of an array by number from 1, others of a table, "" for itself."""
    found: Any = data.get(name)
    if isinstance(found, list):
        items = cast(list[dict[str, Any]], found)
        return {str(place): table for place, table in enumerate(items, 1)}
    if not isinstance(found, dict):
        return {}
    table = cast(dict[str, Any], found)
    return {"": table, **{key: value for key, value in table.items() if isinstance(value, dict)}}


def _value(text: str) -> object:
    """Return a value as TOML has it; a bare word is a text."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except (ValueError, RecursionError):
        return text
