"""People of a calibration session: one at a terminal, and one who has the hands of a simulation.

A person puts the robot where a step wants it and measures what the robot does. In a twin's own process a
simulated person does so with a ruler's errors, from a random stream of the seed; a person at a terminal does
with a real robot, or with a twin that is served.
"""

import math
from collections.abc import Callable
from typing import Protocol

from khep_twin.errors import FitError
from khep_twin.interventions.move_robot import put
from khep_twin.interventions.switching import set_lamps
from khep_twin.lab.fit.placement import Ruler
from khep_twin.lab.fit.session_steps import TURNS, Step
from khep_twin.playpen import Lamp, Lighting
from khep_twin.ports.twin import Twin
from khep_twin.randomness import stream
from khep_twin.units import BODIES, BULB_RADIUS

_MARGIN_MM = 150.0
"""Distance of the robot's start from the wall behind it on the straight drive [mm]."""

_LEAST_MM = 900.0
"""Least size of the arena [mm]: walls 170 mm aside add up to 7 counts 12 mm from the wall (measured)."""


class Person(Protocol):
    """Person who places and measures."""

    def place(self, step: Step) -> float | None:
        """Put the robot, and an object, in their place; return the measured distance [mm], None to skip."""
        ...

    def measure(self, step: Step) -> float | None:
        """Return the length of the drive [mm] or the number of turns; None to drive again."""
        ...


class PersonAtTerminal:
    """Person who reads instructions and types answers.

    Args:
        show: Function that shows a line.
        ask: Function that shows a question and returns the answer.
        wait: False where nothing is to be confirmed before a drive.
    """

    def __init__(self, show: Callable[[str], None], ask: Callable[[str], str], wait: bool = True) -> None:
        self._show, self._ask, self._wait = show, ask, wait

    def place(self, step: Step) -> float | None:
        """Wait for Enter, for another distance, or for s."""
        self._show(step.text)
        if not self._wait:
            return step.distance_mm
        more = ", the distance in mm if it is another" if step.has_object else ""
        while True:
            answer = self._ask(f"Enter to go on{more}, s to skip").strip()
            if answer in ("", "s"):
                return None if answer else step.distance_mm
            if step.has_object and (found := _number(answer)) is not None and 0 <= found <= 1000:
                return found
            self._show(f"{answer[:40]!r}: expected Enter{more}, or s")

    def measure(self, step: Step) -> float | None:
        """Ask until the answer is a number, or s."""
        wish, low, high = "a length in mm, such as 598", 100.0, 5000.0
        if step.kind == "turns":
            wish, low, high = "turns, such as 4.93, or 5 -25 for 5 turns less 25 degrees", 0.5, 100.0
        while True:
            answer = self._ask(f"How far did it go? {wish}; s to drive again").strip()
            if answer == "s":
                return None
            whole, _, degrees = answer.partition(" ")
            found, more = _number(whole), _number(degrees.strip()) if degrees else 0.0
            if found is not None and more is not None and (step.kind == "turns" or not degrees):
                if low <= found + more / 360 <= high:
                    return found + more / 360
            self._show(f"{answer[:40]!r}: expected {wish}")


class SimulatedPerson:
    """Person in a twin's world, whose hands and eyes have a ruler's errors.

    Args:
        twin: Twin on an open floor within white walls.
        ruler: Precision of hands and eyes.
        show: Function that shows a line.

    Raises:
        FitError: The playpen is not such a floor.
    """

    def __init__(self, twin: Twin, ruler: Ruler, show: Callable[[str], None]) -> None:
        self._twin, self._ruler, self._show = twin, ruler, show
        self._rng = stream(twin.options.seed, "calibrate", "person")
        arena, found = twin.world.playpen.arena, twin.world.playpen
        things = sum(map(len, found.objects.values())) + len(found.walls) + len(found.robots) - 1
        self._model = found.robots[twin.robot.index].model
        self._width, self._height = arena.width_mm, arena.height_mm
        problems = {
            "no rectangle": bool(arena.outline_mm),
            f"{self._width:g} x {self._height:g} mm": min(self._width, self._height) < _LEAST_MM,
            f"walls of {arena.surface}": arena.surface != "white",
            f"{things} objects and other robots": things > 0,
        }
        if problem := next((text for text, is_so in problems.items() if is_so), ""):
            raise FitError(
                f"{found.name}: {problem}; expected an empty arena of {_LEAST_MM:g} x {_LEAST_MM:g} mm "
                "and more with white walls, or a served twin to place by hand"
            )

    def place(self, step: Step) -> float | None:
        """Put the robot by the right wall, or on open floor."""
        self._show(step.text)
        if step.kind == "cylinder":
            self._show("A twin's playpen has no cylinder to be moved; skipped.")
            return None
        radius_mm = BODIES[self._model].radius * 1e3
        away_mm = step.distance_mm + self._ruler.distance_mm * float(self._rng.standard_normal())
        heading_deg = self._ruler.bearing_deg * float(self._rng.standard_normal())
        x_mm, y_mm = _MARGIN_MM, self._height / 2
        if step.kind == "wall":
            x_mm = self._width - radius_mm - max(away_mm, 0.5)
        elif step.kind in ("turns", "duty", "lamp"):
            x_mm = self._width / 2
        put(self._twin.world, self._twin.robot.index, x_mm, y_mm, heading_deg)
        lamps: list[Lamp] = []
        if step.kind == "lamp":
            bulb_mm = x_mm + radius_mm + max(away_mm, 0.5) + BULB_RADIUS * 1e3
            lamps = [Lamp(x_mm=bulb_mm, y_mm=y_mm, z_mm=step.height_mm, power_w=step.power_w)]
        set_lamps(self._twin.world, lamps, Lighting())
        self._start = self._twin.robot.pose
        return step.distance_mm

    def measure(self, step: Step) -> float | None:
        """Measure the drive from the last place."""
        (x, y, heading), now = self._start, self._twin.robot.pose
        if step.kind == "straight":
            error = self._ruler.distance_mm * float(self._rng.standard_normal())
            found = math.hypot(now[0] - x, now[1] - y) * 1e3 + error
            self._show(f"It went {found:.2f} mm.")
            return round(found, 2)
        error = self._ruler.bearing_deg * float(self._rng.standard_normal())
        # A person sees the part of a turn and counts the whole ones.
        beyond = (math.degrees(now[2] - heading) + error + 180) % 360 - 180
        self._show(f"It went {TURNS} turns and {beyond:.1f} degrees.")
        return round(TURNS + beyond / 360, 4)


def _number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None
