"""Lamps: their positions, and their brightness over time.

A lamp shines with its power times its dim. It can blink, `on_s` gives the times when it is on, and with
`fade_s` it fades in and out, as a filament does. The playpen's lighting selects which of them are on:
all, or one at a time. Then the next one, at random or in the file's order, is lit when a robot comes near
the lit one or near a wall of the arena; with a distance of 0 the first one stays. Robots have to leave before
they can come near again. The user can switch a lamp off and on again, whatever else switches it.

A lamp with `flicker` swings about that power twice in each period of the mains, all lamps alike and at any
time the same function of time; only the phase at time 0 is drawn by the seed, as no robot knows it.
"""

import math
from collections.abc import Callable, Sequence
from itertools import zip_longest
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field, FiniteFloat

from khep_twin.playpen import BULB_RADIUS_MM, Lamp, Lighting, Playpen
from khep_twin.playpen.polygon import distance
from khep_twin.sensing.light import Light
from khep_twin.units import STEP_NS, metres


class LampsState(NamedTuple):
    """State of the lamps.

    Attributes:
        powers: Current powers (n,) [W].
        lit: Index of the lamp that is on, if they are on one at a time.
        off: Indices of the lamps that the user has switched off.
        near_lamp: Whether a robot is near the lit lamp.
        near_wall: Whether a robot is near a wall.
        time_ns: Time of the last update [ns].
        steady: Whether the powers never change.
        phase: Phase of the mains; None if no lamp flickers.
    """

    powers: tuple[FiniteFloat, ...]
    lit: Annotated[int, Field(ge=0)] | None
    off: tuple[int, ...]
    near_lamp: bool
    near_wall: bool
    time_ns: Annotated[int, Field(ge=0, lt=2**62)]
    steady: bool
    phase: FiniteFloat | None


def are_steady(lamps: Sequence[Lamp], lighting: Lighting) -> bool:
    """Return whether the powers of lamps never change."""
    one_by_one = lighting.mode != "all" and bool(lamps)
    return not one_by_one and not any(lamp.blink_period_s or lamp.on_s for lamp in lamps)


class Lamps:
    """The lamps of one world.

    Args:
        playpen: Playpen with the lamps and the lighting.
        rng: Factory of the random stream for the next lamp, called in mode "random" only.
        time_ns: Current time [ns].
        phase: Phase of the mains, as in `light.LightLaw`; drawn where a lamp flickers if not given.

    Attributes:
        rng: The same factory.
        names: Names in the playpen, else in the scene.
        positions: Positions of the bulbs' centres (n, 3) [m].
        powers: Current powers (n,), without their flicker [W].
        steady: True if the powers never change.
        lit: Index of the lamp that is on, if they are on one at a time; else None.
        phase: Phase of the mains; None if no lamp flickers.
    """

    def __init__(
        self,
        playpen: Playpen,
        rng: Callable[[], np.random.Generator],
        time_ns: int = 0,
        phase: float | None = None,
    ) -> None:
        self._lamps, self._lighting = playpen.lamps, playpen.lighting
        self._corners = [(metres(x_mm), metres(y_mm)) for x_mm, y_mm in playpen.arena.corners]
        self.rng = rng
        self._near_lamp = self._near_wall = True
        self.names = [lamp.name or f"lamp{index}" for index, lamp in enumerate(self._lamps)]
        self.positions = [(metres(lamp.x_mm), metres(lamp.y_mm), metres(lamp.z_mm)) for lamp in self._lamps]
        self._full = [lamp.power_w * lamp.dim for lamp in self._lamps]
        one_by_one = self._lighting.mode != "all" and bool(self._lamps)
        self.steady = are_steady(self._lamps, self._lighting)
        self._off: set[int] = set()
        self.lit: int | None = None
        if one_by_one:
            self.lit = 0
            if self._lighting.mode == "random":
                self.lit = int(rng().integers(len(self._lamps)))
        self.phase = phase
        if phase is None and any(lamp.flicker for lamp in self._lamps):
            self.phase = float(rng().random())
        self._time_ns = time_ns
        self.powers = [self._full[index] * self._wanted(index) for index in range(len(self._lamps))]

    def state(self) -> LampsState:
        """Return the state."""
        off, near = tuple(sorted(self._off)), (self._near_lamp, self._near_wall)
        return LampsState(tuple(self.powers), self.lit, off, *near, self._time_ns, self.steady, self.phase)

    def set_state(self, state: LampsState) -> None:
        """Take over a state.

        Raises:
            ValueError: It is of other lamps.
        """
        count, off = len(self.powers), set(state.off)
        if len(state.powers) != count or not {state.lit or 0, *off} <= {0, *range(count)}:
            raise ValueError(f"a state of {len(state.powers)} lamps; expected one of {count}")
        if (state.lit is None) != (self.lit is None):
            raise ValueError("a state of lamps with another lighting")
        self.powers, self.lit, self._off = list(state.powers), state.lit, off
        self._near_lamp, self._near_wall = state.near_lamp, state.near_wall
        self._time_ns, self.steady, self.phase = state.time_ns, state.steady, state.phase

    def take_over(self, before: "Lamps") -> None:
        """Go on as other lamps: those off by hand stay off, and the one that is on in its turn stays on."""
        count = len(self.powers)
        for index in sorted(before._off & {*range(count)}):
            self.turn(index, False, self._time_ns)
        if self.lit is not None and before.lit is not None and before.lit < count:
            self.lit, self._near_lamp, self._near_wall = before.lit, before._near_lamp, before._near_wall
        for index, (full, other) in enumerate(zip_longest(self._full, before._full[:count])):
            self.powers[index] = before.powers[index] if full == other else full * self._wanted(index)

    def turn(self, index: int, on: bool, time_ns: int) -> None:
        """Switch a lamp by hand at a time [ns]: off, or back to its own schedule."""
        (self._off.discard if on else self._off.add)(index)
        if self.steady:  # `update` has not been called so far
            self._time_ns = time_ns
        self.steady = False

    def turned_off(self, index: int) -> bool:
        """Return whether the user has switched a lamp off."""
        return index in self._off

    def flickering(self, light: Light) -> Light:
        """Return a scene's light with the flicker of these lamps."""
        if self.phase is None:
            return light
        law = light.law._replace(phase=self.phase)
        pairs = zip(light.bulbs, self._lamps, strict=True)
        return light._replace(law=law, bulbs=[bulb._replace(flicker=lamp.flicker) for bulb, lamp in pairs])

    def update(self, time_ns: int, robots: Sequence[tuple[float, float, float]]) -> bool:
        """Advance the lamps to a time.

        Args:
            time_ns: Current time [ns].
            robots: Centres and radii of the robots: x, y, radius [m].

        Returns:
            True if another lamp is on now.
        """
        elapsed_s, self._time_ns = (time_ns - self._time_ns) * 1e-9, time_ns
        switched = self.lit is not None and self._switch(self.lit, robots)
        for index, lamp in enumerate(self._lamps):
            wanted, power = self._full[index] * self._wanted(index), self.powers[index]
            step = self._full[index] * elapsed_s / lamp.fade_s if lamp.fade_s else math.inf
            self.powers[index] = min(max(wanted, power - step), power + step)
        return switched

    def rows(self, first: int, end: int, step_ns: int = STEP_NS) -> list[list[float]]:
        """Advance lamps that take no turns by some steps; return the powers after each of them [W]."""
        found: list[list[float]] = []
        for step in range(first + 1, end + 1):
            self.update(step * step_ns, ())
            found.append(self.powers.copy())
        return found

    def possible_powers(self, time_ns: int) -> list[float]:
        """Return the powers of all lamps, each as if it were the one that is on, at a time [ns]."""
        pairs = zip(self._full, self._lamps, strict=True)
        return [full * _in_its_turn(lamp, time_ns) for full, lamp in pairs]

    def _wanted(self, index: int) -> bool:
        """Return whether a lamp is on."""
        if self.lit not in (None, index) or index in self._off:
            return False
        return _in_its_turn(self._lamps[index], self._time_ns)

    def _switch(self, lit: int, robots: Sequence[tuple[float, float, float]]) -> bool:
        """Advance to the next lamp if a robot has just come near this one or a wall; return True then."""
        reach = metres(self._lighting.switch_distance_mm)
        if not reach:
            return False
        near_wall = any(distance(self._corners, x, y) < reach + radius for x, y, radius in robots)
        near_lamp = self._near(lit, reach, robots)
        came = (near_wall and not self._near_wall) or (near_lamp and not self._near_lamp)
        self._near_wall, self._near_lamp = near_wall, near_lamp
        if not came or len(self._lamps) == 1:
            return False
        step = 1
        if self._lighting.mode == "random":
            step = 1 + int(self.rng().integers(len(self._lamps) - 1))
        self.lit = (lit + step) % len(self._lamps)
        self._near_lamp = self._near(self.lit, reach, robots)
        return True

    def _near(self, index: int, reach: float, robots: Sequence[tuple[float, float, float]]) -> bool:
        x, y, _ = self.positions[index]
        reach += metres(BULB_RADIUS_MM)
        return any(math.hypot(x - at_x, y - at_y) < reach + radius for at_x, at_y, radius in robots)


def _in_its_turn(lamp: Lamp, time_ns: int) -> bool:
    """Return whether a lamp is on by its times and its blinking; each period begins with it on."""
    if lamp.on_s and not any(round(on * 1e9) <= time_ns < round(off * 1e9) for on, off in lamp.on_s):
        return False
    if not lamp.blink_period_s:
        return True
    period_ns = round(lamp.blink_period_s * 1e9)
    return time_ns % period_ns < round(period_ns * lamp.blink_duty)
