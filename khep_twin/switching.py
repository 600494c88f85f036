"""Switching lamps in a world that runs, as a hand does, and setting up others; acts that a log repeats."""

import json
import struct
from collections.abc import Sequence
from typing import Any, cast

from khep_twin.board.uart import Act, HostAct
from khep_twin.errors import PlaypenError, choices
from khep_twin.files.toml_files import Table, check, frozen
from khep_twin.playpen import Lamp, Lighting, Playpen
from khep_twin.world import World

_SWITCH = struct.Struct("<i?")


def switch(world: World, lamp: int, on: bool) -> None:
    """Switches a lamp off, or back to what it does by itself.

    Args:
        world: in which it is.
        lamp: which of its lamps, from 0.
        on: whether it may shine.

    Raises:
        PlaypenError: there is no such lamp.
    """
    names = world.lamps.names
    if not 0 <= lamp < len(names):
        raise PlaypenError(f"lamp = {lamp}: there is none; {choices(lamp, range(len(names)))}")
    world.act(0, HostAct(Act.SWITCH, world.time_ns, None, _SWITCH.pack(lamp, on)))
    world.lamps.turn(lamp, on, world.time_ns)
    world.tell(None, f"{names[lamp]} is switched {'on' if on else 'off'} by hand")


def switch_again(world: World, act: HostAct) -> None:
    """Switches a lamp as a log has it."""
    switch(world, *_SWITCH.unpack(act.data))


def relight(world: World, lamps: Sequence[Lamp], lighting: Lighting) -> None:
    """Set up other lamps, or let them shine in another order.

    Args:
        world: in which they are.
        lamps: all that there are from now on.
        lighting: which of them are on, from now on.

    Raises:
        PlaypenError: a lamp cannot be like that, or lies outside the arena.
    """
    wanted = {
        "lamp": [lamp.model_dump(mode="json") for lamp in lamps],
        "lighting": lighting.model_dump(mode="json"),
    }
    before = world.playpen
    bare = {"version": before.version, "name": before.name, "arena": before.arena.model_dump()}
    checked = check(Playpen, frozen(bare | wanted), before.name, PlaypenError)
    world.act(0, HostAct(Act.RELIGHT, world.time_ns, None, json.dumps(wanted).encode("utf-8")))
    world.relight(before.model_copy(update={"lamps": checked.lamps, "lighting": checked.lighting}))
    places = ", ".join(f"{lamp.power_w:g} W at ({lamp.x_mm:g}, {lamp.y_mm:g})" for lamp in checked.lamps)
    world.tell(None, f"the lamps are {places or 'gone'}; on: {lighting.mode}")


def relight_again(world: World, act: HostAct) -> None:
    """Sets up lamps as a log has it.

    Raises:
        PlaypenError: its bytes are not as `relight` writes them.
    """
    try:
        wanted = frozen(json.loads(act.data))
        if not isinstance(wanted, dict):
            raise TypeError
    except (ValueError, TypeError, RecursionError):
        raise PlaypenError(f"lamps = {act.data[:40]!r}: right is JSON with lamp and lighting") from None
    checked = check(_Lamps, cast(dict[str, Any], wanted), "lamps", PlaypenError)
    relight(world, checked.lamp, checked.lighting)


class _Lamps(Table):
    """What an act says of lamps."""

    lamp: tuple[Lamp, ...]
    lighting: Lighting
