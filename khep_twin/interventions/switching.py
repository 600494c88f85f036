"""Changes to the lamps of a running world by the user, as actions that a log repeats."""

import json
import struct
from collections.abc import Sequence
from typing import cast

from khep_twin.board.uart import HostEvent, HostEventKind
from khep_twin.errors import PlaypenError
from khep_twin.files.toml_files import TomlTable, check, freeze
from khep_twin.playpen import Lamp, Lighting, Playpen
from khep_twin.world import World

_SWITCH = struct.Struct("<i?")


def switch(world: World, lamp: int, on: bool) -> None:
    """Switch a lamp off, or back to its schedule.

    Args:
        world: World of the lamp.
        lamp: Number of the lamp, from 0.
        on: True to return it to its schedule, False to switch it off.

    Raises:
        PlaypenError: The lamp does not exist.
    """
    names = world.lamps.names
    if not 0 <= lamp < len(names):
        message = f"lamp = {lamp}: there is none"
        raise PlaypenError(message, key="lamp", value=lamp, expected=range(len(names)))
    event = HostEvent(HostEventKind.SWITCH_LAMP, world.time_ns, None, _SWITCH.pack(lamp, on))
    world.observers.on_host_event(0, event)
    world.lamps.switch(lamp, on, world.time_ns)
    world.observers.on_event(None, f"{names[lamp]} is switched {'on' if on else 'off'} by hand")


def repeat_switch(world: World, event: HostEvent) -> None:
    """Switch a lamp as recorded in a log."""
    switch(world, *_SWITCH.unpack(event.data))


def set_lamps(world: World, lamps: Sequence[Lamp], lighting: Lighting) -> None:
    """Replace the lamps and their lighting.

    Args:
        world: World of the lamps.
        lamps: All lamps from now on.
        lighting: Lighting from now on.

    Raises:
        PlaypenError: A lamp is invalid or lies outside the arena.
    """
    lamp_values = {
        "lamp": [lamp.model_dump(mode="json") for lamp in lamps],
        "lighting": lighting.model_dump(mode="json"),
    }
    current = world.playpen
    arena_data = {"version": current.version, "name": current.name, "arena": current.arena.model_dump()}
    checked = check(Playpen, freeze(arena_data | lamp_values), current.name, PlaypenError)
    world.observers.on_host_event(
        0, HostEvent(HostEventKind.SET_LAMPS, world.time_ns, None, json.dumps(lamp_values).encode("utf-8"))
    )
    world.set_lamps(checked.lamps, checked.lighting)
    lamps_text = ", ".join(f"{lamp.power_w:g} W at ({lamp.x_mm:g}, {lamp.y_mm:g})" for lamp in checked.lamps)
    world.observers.on_event(None, f"the lamps are {lamps_text or 'gone'}; on: {lighting.mode}")


def repeat_set_lamps(world: World, event: HostEvent) -> None:
    """Replace the lamps as recorded in a log.

    Raises:
        PlaypenError: The bytes are not as `set_lamps` writes them.
    """
    try:
        values = json.loads(event.data)
        if not isinstance(values, dict):
            raise TypeError
        lamp_values = freeze(cast(dict[str, object], values))
    except (ValueError, TypeError, RecursionError):
        raise PlaypenError(f"lamps = {event.data[:40]!r}; expected JSON with lamp and lighting") from None
    checked = check(_Lamps, lamp_values, "lamps", PlaypenError)
    set_lamps(world, checked.lamp, checked.lighting)


class _Lamps(TomlTable):
    """Lamps and lighting of an action."""

    lamp: tuple[Lamp, ...]
    lighting: Lighting
