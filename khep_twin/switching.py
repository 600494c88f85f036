"""Switching a lamp in a world that runs, as a hand does; an act like a host's, so that a log repeats it."""

import struct

from khep_twin.errors import PlaypenError, choices
from khep_twin.uart import Act, HostAct
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
