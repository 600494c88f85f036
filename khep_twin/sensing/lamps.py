"""Lamps: their positions, and their brightness over time.

The maximum power of a lamp is its power times its dimming factor `dim`. It can blink, `on_s` lists the
intervals when it is on, and with `fade_s` it fades in and out like a filament. The lamps of a playpen are on
all together or one at a time. Then the next one, at random or in the file's order, is switched on when a
robot comes near the current one or a wall of the arena; with a switch distance of 0 the first one stays on.
A robot must leave before it can come near again. The user can also switch lamps off and on.

A lamp with `flicker` oscillates around that power twice in each period of the mains, in phase with all other
lamps. The phase at time 0 is drawn from the random stream, as no robot knows it.
"""

import math
from collections.abc import Callable, Sequence
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
        lit_index: Index of the lamp that is on, if they are on one at a time.
        switched_off: Indices of the lamps that the user has switched off.
        was_near_lamp: Whether a robot was near the lamp that is on, at the last update.
        was_near_wall: Whether a robot was near a wall, at the last update.
        time_ns: Time of the last update [ns].
        are_constant: Whether the powers never change.
        flicker_phase: Phase of the flicker at time 0, in periods; None if no lamp flickers.
    """

    powers: tuple[FiniteFloat, ...]
    lit_index: Annotated[int, Field(ge=0)] | None
    switched_off: tuple[int, ...]
    was_near_lamp: bool
    was_near_wall: bool
    time_ns: Annotated[int, Field(ge=0, lt=2**62)]
    are_constant: bool
    flicker_phase: FiniteFloat | None


def are_constant(lamps: Sequence[Lamp], lighting: Lighting) -> bool:
    """Return whether the powers of lamps never change."""
    one_at_a_time = lighting.mode != "all" and bool(lamps)
    return not one_at_a_time and not any(lamp.blink_period_s or lamp.on_s for lamp in lamps)


class Lamps:
    """Lamps of one world.

    Args:
        playpen: Playpen with the lamps and the lighting.
        make_rng: Function that returns the random stream: for the next lamp in mode "random", and for the
            phase of lamps that flicker.
        time_ns: Current time [ns].
        flicker_phase: Phase as in `light.LightLaw`; by default it is drawn if a lamp flickers.

    Attributes:
        make_rng: The same function.
        names: Names in the playpen, or by default in the scene.
        positions: Positions of the bulbs' centres (n, 3) [m].
        powers: Current powers (n,), without their flicker [W].
        are_constant: True if the powers never change.
        lit_index: Index of the lamp that is on, if they are on one at a time; otherwise None.
        flicker_phase: Phase of the flicker at time 0, in periods; None if no lamp flickers.
    """

    def __init__(
        self,
        playpen: Playpen,
        make_rng: Callable[[], np.random.Generator],
        time_ns: int = 0,
        flicker_phase: float | None = None,
    ) -> None:
        self._lamps, self._lighting = playpen.lamps, playpen.lighting
        self._corners = [(metres(x_mm), metres(y_mm)) for x_mm, y_mm in playpen.arena.corners]
        self.make_rng = make_rng
        self._was_near_lamp = self._was_near_wall = True
        self.names = [lamp.name or f"lamp{index}" for index, lamp in enumerate(self._lamps)]
        self.positions = [(metres(lamp.x_mm), metres(lamp.y_mm), metres(lamp.z_mm)) for lamp in self._lamps]
        self._max_powers_w = [lamp.power_w * lamp.dim for lamp in self._lamps]
        one_at_a_time = self._lighting.mode != "all" and bool(self._lamps)
        self.are_constant = are_constant(self._lamps, self._lighting)
        self._switched_off: set[int] = set()
        self.lit_index: int | None = None
        if one_at_a_time:
            self.lit_index = 0
            if self._lighting.mode == "random":
                self.lit_index = int(make_rng().integers(len(self._lamps)))
        self.flicker_phase = flicker_phase
        if flicker_phase is None and any(lamp.flicker for lamp in self._lamps):
            self.flicker_phase = float(make_rng().random())
        self._time_ns = time_ns
        self.powers = [self._max_powers_w[index] * self._is_on(index) for index in range(len(self._lamps))]

    def state(self) -> LampsState:
        """Return the state."""
        return LampsState(
            tuple(self.powers),
            self.lit_index,
            tuple(sorted(self._switched_off)),
            self._was_near_lamp,
            self._was_near_wall,
            self._time_ns,
            self.are_constant,
            self.flicker_phase,
        )

    def set_state(self, state: LampsState) -> None:
        """Restore a state.

        Raises:
            ValueError: The state is of other lamps.
        """
        count, switched_off = len(self.powers), set(state.switched_off)
        if len(state.powers) != count or not {state.lit_index or 0, *switched_off} <= {0, *range(count)}:
            raise ValueError(f"a state of {len(state.powers)} lamps; expected one of {count}")
        if (state.lit_index is None) != (self.lit_index is None):
            raise ValueError("a state of lamps with another lighting")
        self.powers = list(state.powers)
        self.lit_index = state.lit_index
        self._switched_off = switched_off
        self._was_near_lamp = state.was_near_lamp
        self._was_near_wall = state.was_near_wall
        self._time_ns = state.time_ns
        self.are_constant = state.are_constant
        self.flicker_phase = state.flicker_phase

    def continue_from(self, previous: "Lamps") -> None:
        """Continue from other lamps: lamps that the user switched off stay off, and `lit_index` is kept."""
        count = len(self.powers)
        for index in sorted(previous._switched_off & {*range(count)}):
            self.switch(index, False, self._time_ns)
        if self.lit_index is not None and previous.lit_index is not None and previous.lit_index < count:
            self.lit_index = previous.lit_index
            self._was_near_lamp = previous._was_near_lamp
            self._was_near_wall = previous._was_near_wall
        for index, max_power_w in enumerate(self._max_powers_w):
            if previous._max_powers_w[index : index + 1] == [max_power_w]:
                self.powers[index] = previous.powers[index]
            else:
                self.powers[index] = max_power_w * self._is_on(index)

    def switch(self, index: int, is_on: bool, time_ns: int) -> None:
        """Switch a lamp manually at a time [ns]: off, or back to its schedule."""
        (self._switched_off.discard if is_on else self._switched_off.add)(index)
        if self.are_constant:  # `update` has not been called so far
            self._time_ns = time_ns
        self.are_constant = False

    def is_switched_off(self, index: int) -> bool:
        """Return whether the user has switched a lamp off."""
        return index in self._switched_off

    def add_flicker(self, light: Light) -> Light:
        """Return a scene's light with the flicker of these lamps."""
        if self.flicker_phase is None:
            return light
        law = light.law._replace(flicker_phase=self.flicker_phase)
        pairs = zip(light.bulbs, self._lamps, strict=True)
        return light._replace(law=law, bulbs=[bulb._replace(flicker=lamp.flicker) for bulb, lamp in pairs])

    def update(self, time_ns: int, robots: Sequence[tuple[float, float, float]]) -> bool:
        """Advance the lamps to a time.

        Args:
            time_ns: Current time [ns].
            robots: Centres and radii of the robots: x, y, radius [m].

        Returns:
            True if another lamp has been switched on.
        """
        elapsed_s, self._time_ns = (time_ns - self._time_ns) * 1e-9, time_ns
        has_switched = self.lit_index is not None and self._switch_to_next(self.lit_index, robots)
        for index, lamp in enumerate(self._lamps):
            target, power = self._max_powers_w[index] * self._is_on(index), self.powers[index]
            max_change = self._max_powers_w[index] * elapsed_s / lamp.fade_s if lamp.fade_s else math.inf
            self.powers[index] = min(max(target, power - max_change), power + max_change)
        return has_switched

    def advance_steps(self, start_step: int, end_step: int, step_ns: int = STEP_NS) -> list[list[float]]:
        """Advance lamps without `lit_index` to `end_step`; return the powers after each step [W]."""
        rows: list[list[float]] = []
        for step in range(start_step + 1, end_step + 1):
            self.update(step * step_ns, ())
            rows.append(self.powers.copy())
        return rows

    def possible_powers(self, time_ns: int) -> list[float]:
        """Return the powers of the lamps at a time [ns], each as if `lit_index` were its index."""
        pairs = zip(self._max_powers_w, self._lamps, strict=True)
        return [power_w * _is_scheduled_on(lamp, time_ns) for power_w, lamp in pairs]

    def _is_on(self, index: int) -> bool:
        """Return whether a lamp is on."""
        if self.lit_index not in (None, index) or index in self._switched_off:
            return False
        return _is_scheduled_on(self._lamps[index], self._time_ns)

    def _switch_to_next(self, lit_index: int, robots: Sequence[tuple[float, float, float]]) -> bool:
        """Switch to the next lamp if a robot has just come near this one or a wall; return whether it has."""
        max_distance = metres(self._lighting.switch_distance_mm)
        if not max_distance:
            return False
        is_near_wall = any(distance(self._corners, x, y) < max_distance + radius for x, y, radius in robots)
        is_near_lamp = self._is_near(lit_index, max_distance, robots)
        has_entered = (is_near_wall and not self._was_near_wall) or (is_near_lamp and not self._was_near_lamp)
        self._was_near_wall, self._was_near_lamp = is_near_wall, is_near_lamp
        if not has_entered or len(self._lamps) == 1:
            return False
        offset = 1
        if self._lighting.mode == "random":
            offset = 1 + int(self.make_rng().integers(len(self._lamps) - 1))
        self.lit_index = (lit_index + offset) % len(self._lamps)
        self._was_near_lamp = self._is_near(self.lit_index, max_distance, robots)
        return True

    def _is_near(self, index: int, max_distance: float, robots: Sequence[tuple[float, float, float]]) -> bool:
        """Return whether a robot (x, y, radius) is within `max_distance` of a bulb's surface [m]."""
        x, y, _ = self.positions[index]
        max_distance += metres(BULB_RADIUS_MM)
        return any(math.hypot(x - rx, y - ry) < max_distance + radius for rx, ry, radius in robots)


def _is_scheduled_on(lamp: Lamp, time_ns: int) -> bool:
    """Return whether a lamp is on by its intervals and its blinking; each period starts with it on."""
    if lamp.on_s and not any(round(on * 1e9) <= time_ns < round(off * 1e9) for on, off in lamp.on_s):
        return False
    if not lamp.blink_period_s:
        return True
    period_ns = round(lamp.blink_period_s * 1e9)
    return time_ns % period_ns < round(period_ns * lamp.blink_duty)
