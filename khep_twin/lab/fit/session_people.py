"""Persons of a calibration session: one at a terminal, and a simulated one.

A person puts the robot where a step requires it and measures its drive. For a twin in this process, a
simulated person does so with a ruler's errors, drawn from a random stream of the seed. For a real robot or a
served twin, a person at a terminal follows instructions.
"""

import math
from collections.abc import Callable

from khep_twin.errors import FitError
from khep_twin.interventions.move_robot import place_robot, scan
from khep_twin.interventions.switching import set_lamps
from khep_twin.lab.fit.placement import Ruler
from khep_twin.lab.fit.session_steps import TURNS, Step
from khep_twin.playpen import Lamp, Lighting
from khep_twin.ports.twin import Twin
from khep_twin.randomness import stream
from khep_twin.robots.registry import find_model
from khep_twin.units import BULB_RADIUS

_MARGIN_MM = 150.0
"""Distance of the robot's start from the wall behind it on the straight drive [mm]."""
_MIN_ARENA_MM = 900.0
"""Smallest size of the arena [mm]: walls 170 mm aside add up to 7 counts 12 mm from the wall (measured)."""


class PersonAtTerminal:
    """Person who reads instructions and types answers.

    Args:
        show: Function that shows a line.
        ask: Function that shows a question and returns the answer.
        wait: False to drive without a confirmation.
    """

    def __init__(self, show: Callable[[str], None], ask: Callable[[str], str], wait: bool = True) -> None:
        self._show, self._ask, self._wait = show, ask, wait

    def place(self, step: Step) -> float | None:
        """Show the instruction; return the distance [mm], or None if the answer is s."""
        self._show(step.instruction)
        if not self._wait:
            return step.distance_mm
        option = ", the distance in mm if it is another" if step.has_object else ""
        while True:
            answer = self._ask(f"Enter to go on{option}, s to skip").strip()
            if answer in ("", "s"):
                return None if answer else step.distance_mm
            if step.has_object and (value := _parse_number(answer)) is not None and 0 <= value <= 1000:
                return value
            self._show(f"{answer[:40]!r}: expected Enter{option}, or s")

    def measure(self, step: Step) -> float | None:
        """Ask for the length of the drive [mm] or the number of turns; return None for s, to repeat it."""
        expected, low, high = "a length in mm, such as 598", 100.0, 5000.0
        if step.kind == "turns":
            expected, low, high = "turns, such as 4.93, or 5 -25 for 5 turns less 25 degrees", 0.5, 100.0
        while True:
            answer = self._ask(f"How far did it go? {expected}; s to drive again").strip()
            if answer == "s":
                return None
            count, _, degrees = answer.partition(" ")
            number, degrees_more = _parse_number(count), _parse_number(degrees.strip()) if degrees else 0.0
            if number is not None and degrees_more is not None and (step.kind == "turns" or not degrees):
                if low <= number + degrees_more / 360 <= high:
                    return number + degrees_more / 360
            self._show(f"{answer[:40]!r}: expected {expected}")


class SimulatedPerson:
    """Simulated person in a twin's world, who places and measures with a ruler's errors.

    Args:
        twin: Twin on an open floor within white walls.
        ruler: Precision of placing and measuring.
        show: Function that shows a line.

    Raises:
        FitError: The playpen is not an open floor within white walls.
    """

    def __init__(self, twin: Twin, ruler: Ruler, show: Callable[[str], None]) -> None:
        self._twin, self._ruler, self._show = twin, ruler, show
        self._rng = stream(twin.options.seed, "calibrate", "person")
        arena, playpen = twin.world.playpen.arena, twin.world.playpen
        n_objects = sum(map(len, playpen.obstacles.values())) + len(playpen.robots) - 1
        self._model = find_model(playpen.robots[twin.robot.index].model)
        least_mm = self._model.fit_bench.height_mm
        self._width_mm, self._height_mm = arena.width_mm, arena.height_mm
        problems = {
            "no rectangle": bool(arena.outline_mm),
            f"{arena.width_mm:g} x {arena.height_mm:g} mm": min(arena.width_mm, arena.height_mm)
            < _MIN_ARENA_MM,
            f"walls {arena.wall_height_mm:g} mm high": arena.wall_height_mm < least_mm,
            f"walls of {arena.surface}": arena.surface != "white",
            f"{n_objects} objects and other robots": n_objects > 0,
        }
        if problem := next((text for text, is_present in problems.items() if is_present), ""):
            raise FitError(
                f"{playpen.name}: {problem}; expected an empty arena of {_MIN_ARENA_MM:g} x "
                f"{_MIN_ARENA_MM:g} mm and more with white walls of {least_mm:g} mm and more, "
                "or a served twin to place by hand"
            )

    def place(self, step: Step) -> float | None:
        """Put the robot in front of the right wall, or on open floor."""
        self._show(step.instruction)
        if step.kind == "cylinder":
            self._show("A twin's playpen has no cylinder to be moved; skipped.")
            return None
        radius_mm = self._model.body.radius * 1e3
        distance_mm = step.distance_mm + self._ruler.distance_mm * float(self._rng.standard_normal())
        heading_deg = self._ruler.bearing_deg * float(self._rng.standard_normal())
        x_mm, y_mm = _MARGIN_MM, self._height_mm / 2
        if step.kind == "wall":
            x_mm = self._width_mm - radius_mm - max(distance_mm, 0.5)
        elif step.kind in ("turns", "duty", "lamp"):
            x_mm = self._width_mm / 2
        place_robot(self._twin.world, self._twin.robot.index, x_mm, y_mm, heading_deg)
        lamps: list[Lamp] = []
        if step.kind == "lamp":
            bulb_mm = x_mm + radius_mm + max(distance_mm, 0.5) + BULB_RADIUS * 1e3
            lamps = [Lamp(x_mm=bulb_mm, y_mm=y_mm, z_mm=step.height_mm, power_w=step.power_w)]
        set_lamps(self._twin.world, lamps, Lighting())
        scan(self._twin.world)  # otherwise the first readings are those before the move
        self._start_pose = self._twin.robot.pose
        return step.distance_mm

    def measure(self, step: Step) -> float | None:
        """Measure the drive since the last `place`."""
        (x, y, heading), end = self._start_pose, self._twin.robot.pose
        if step.kind == "straight":
            error = self._ruler.distance_mm * float(self._rng.standard_normal())
            distance_mm = math.hypot(end[0] - x, end[1] - y) * 1e3 + error
            self._show(f"It went {distance_mm:.2f} mm.")
            return round(distance_mm, 2)
        error = self._ruler.bearing_deg * float(self._rng.standard_normal())
        # A person counts complete turns and sees the remaining angle.
        remainder_deg = (math.degrees(end[2] - heading) + error + 180) % 360 - 180
        self._show(f"It went {TURNS} turns and {remainder_deg:.1f} degrees.")
        return round(TURNS + remainder_deg / 360, 4)


Person = PersonAtTerminal | SimulatedPerson
"""Person who places and measures."""


def _parse_number(text: str) -> float | None:
    try:
        value = float(text)
    except ValueError:
        return None
    return value if math.isfinite(value) else None
