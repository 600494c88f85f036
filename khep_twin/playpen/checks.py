"""Checks across a playpen's parts: surfaces exist, robots are consistent, and no parts collide."""

from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from itertools import chain, islice
from pathlib import Path
from typing import TypeVar, cast

from khep_twin.board.turrets import find_turrets
from khep_twin.errors import Location, PlaypenError, Problem, TurretError
from khep_twin.playpen.footprint import find_overhangs, overlap
from khep_twin.playpen.overlap import PlacedPart, centre_problems, part_label, placement_problems
from khep_twin.playpen.parts import (
    BULB_RADIUS_MM,
    SHORTEST_BLINK_S,
    Lamp,
    Obstacle,
    Patch,
    RobotEntry,
    Spot,
    Wall,
    model_defaults,
)
from khep_twin.playpen.polygon import edges
from khep_twin.playpen.stripes import PANEL_LIMIT
from khep_twin.playpen.surfaces import BUILT_IN_SURFACES
from khep_twin.playpen.tables import PlaypenTables
from khep_twin.robots.model import Feature
from khep_twin.robots.registry import is_installed, model_refusal

LOWEST_WALL_MM, LOWEST_WALL_WITH_TURRET_MM = 15.0, 30.0
"""Lowest walls of an arena with bare robots, and with turrets [mm]. At full speed,
7 of 42 drives of 20 s ended beyond walls of 8 mm, 2 beyond 10 mm, none beyond 12 and 15 mm; with a gripper,
which is top-heavy, 7 beyond 12 mm and 2 beyond 15 mm (measured)."""

MIN_THICKNESS_MM, MIN_MASS_G = 10.0, 5.0
"""Least thickness of an arena's walls [mm] and mass of movable objects [g] if there is a robot. In 2,000
random drives of 10 s a cylinder was pressed through walls of 1 to 3 mm in four, of 1 g also through 10 mm in
one of 1,000; from 5 g and 10 mm on, in none (measured)."""

_Part = TypeVar("_Part", bound=Obstacle | Patch | Lamp | Spot | RobotEntry)

_ASSIGNMENT_LIMIT = 20_000
"""Most placements of robots at spots that are tried."""


def playpen_problems(
    playpen: PlaypenTables, recorded: bool = False, placed: bool = True
) -> Iterator[Problem]:
    """Yield the problems of a playpen whose tables are valid separately.

    Args:
        playpen: Playpen to check.
        recorded: True for a playpen of a recorded run: the height of its walls is not checked.
        placed: Whether to check that no parts collide.
    """
    outline = [Problem(("arena", "outline_mm"), text) for text in playpen.arena.outline_problems()]
    if outline:
        return iter(outline)
    return chain(
        () if recorded else _arena_problems(playpen),
        _surface_problems(playpen),
        _wall_problems(playpen),
        _patch_problems(playpen, placed),
        _lamp_problems(playpen),
        _robot_problems(playpen),
        _name_problems(playpen),
        placement_problems(list(placed_parts(playpen)), playpen.arena) if placed else (),
    )


def require_feature(playpen: PlaypenTables, feature: Feature, indices: Container[int] | None = None) -> None:
    """Raise a `PlaypenError` where the model of a robot, or of one of these, does not support a use."""
    for number, robot in enumerate(playpen.robots, 1):
        if (indices is None or number - 1 in indices) and feature not in robot.robot_model.features:
            raise PlaypenError(f"{playpen.name}: robot {number}: {model_refusal(robot.model, feature)}")


def at_spot(robot: RobotEntry, spot: Spot) -> RobotEntry:
    """Return a robot that stands at a spot."""
    return robot.model_copy(update={"x_mm": spot.x_mm, "y_mm": spot.y_mm, "heading_deg": spot.heading_deg})


def assign_spots(
    playpen: PlaypenTables, order_spots: Callable[[Sequence[str]], Sequence[str]]
) -> list[RobotEntry] | None:
    """Return the robots at one spot each, clear of each other; None if that is impossible.

    Args:
        playpen: Playpen with robots and spots.
        order_spots: Function that orders a robot's spots for the search.
    """
    spots = {spot.name: spot for spot in playpen.spots}
    robots = list(playpen.robots)
    indices = [index for index, robot in enumerate(robots) if robot.spots]
    candidates = {index: [spots[name] for name in order_spots(robots[index].spots)] for index in indices}
    footprints = [robot.footprint for robot in robots if not robot.spots]
    n_fixed = len(footprints)
    steps = 1
    untried = [iter(candidates[index]) for index in indices[:1]]
    while untried:
        index = indices[len(untried) - 1]
        del footprints[n_fixed + len(untried) - 1 :]
        for spot in untried[-1] if steps < _ASSIGNMENT_LIMIT else ():
            robot = at_spot(robots[index], spot)
            footprint = robot.footprint
            if not any(overlap(other, footprint) for other in footprints):
                robots[index] = robot
                footprints.append(footprint)
                break
        else:
            untried.pop()
            continue
        if len(untried) == len(indices):
            return robots
        steps += 1
        untried.append(iter(candidates[indices[len(untried)]]))
    return None if indices else robots


def complete_robots(data: dict[str, object]) -> dict[str, object]:
    """Return a file's content with the robots' keys that follow from their spots and models."""
    spots = {str(spot.get("name")): spot for spot in _read_tables(data, "spot")}
    robots: list[dict[str, object]] = []
    for robot in _read_tables(data, "robot"):
        robot_spots = [spots[name] for name in map(str, _read_array(robot, "spots")) if name in spots]
        defaults = default_keys(str(robot.get("model")), robot_spots)
        if not robot_spots and _read_array(robot, "spots"):
            # Unknown names are reported later.
            defaults |= {"x_mm": 0.0, "y_mm": 0.0, "heading_deg": 0.0}
        robots.append({**defaults, **robot})
        usual = defaults.get("calibration")
        if usual is not None and robot.get("calibration") == Path(str(usual)).stem:
            robots[-1]["calibration"] = usual
    return {**data, "robot": tuple(robots)} if robots else data


def default_keys(model: str, spots: Sequence[Mapping[str, object]]) -> dict[str, object]:
    """Return a robot's keys that follow from its model and spots, for a file that omits them."""
    first_spot: Mapping[str, object] = spots[0] if spots else {}
    pose = {key: first_spot[key] for key in ("x_mm", "y_mm", "heading_deg") if key in first_spot}
    defaults: Mapping[str, str] = model_defaults(model) if is_installed(model) else {}
    return {**defaults, **pose}


def _read_tables(data: dict[str, object], kind: str) -> list[dict[str, object]]:
    """Return an array of tables of a file; empty for other values."""
    items = _read_array(data, kind)
    tables = [cast(dict[str, object], item) for item in items if isinstance(item, dict)]
    return tables if len(tables) == len(items) else []


def _read_array(data: dict[str, object], key: str) -> tuple[object, ...]:
    """Return an array of a file; empty for other values."""
    value = data.get(key)
    return cast(tuple[object, ...], value) if isinstance(value, tuple) else ()


def _labelled(tables: Mapping[str, Sequence[_Part]]) -> Iterator[tuple[Location, str, _Part]]:
    """Yield location, name in messages and content of each part of these tables."""
    for kind, items in tables.items():
        for index, item in enumerate(items):
            yield (kind, index), part_label(kind, index + 1, item.name), item


def _arena_problems(playpen: PlaypenTables) -> Iterator[Problem]:
    for location, name, block in _labelled({"block": playpen.blocks}):
        if block.ramp and (block.movable or block.stripes):
            text = f"{name}: ramp, movable or striped"
            yield Problem.of((*location, "ramp"), text, "a ramp that is neither")
    if playpen.arena.table:
        yield from _table_problems(playpen)
        return
    height_mm, turrets = playpen.arena.wall_height_mm, any(robot.turrets for robot in playpen.robots)
    lowest_mm = LOWEST_WALL_WITH_TURRET_MM if turrets else LOWEST_WALL_MM
    if playpen.robots and height_mm < lowest_mm:
        outcome = "a robot with a turret topples over it" if turrets else "a robot drives over it"
        text = f"arena: wall_height_mm = {height_mm:g}: {outcome} at full speed"
        yield Problem.of(("arena", "wall_height_mm"), text, f"at least {lowest_mm:g}")
    thickness_mm = playpen.arena.wall_thickness_mm
    movable = [
        (kind, index, item)
        for kind, items in playpen.objects.items()
        for index, item in enumerate(items)
        if item.movable and playpen.robots
    ]
    if movable and thickness_mm < MIN_THICKNESS_MM:
        text = f"arena: wall_thickness_mm = {thickness_mm:g}: a robot presses movable things through it"
        yield Problem.of(("arena", "wall_thickness_mm"), text, f"at least {MIN_THICKNESS_MM:g}")
    for kind, index, item in movable:
        if item.mass_g < MIN_MASS_G:
            text = f"{kind} {index + 1}: mass_g = {item.mass_g:g}: a robot presses it through walls"
            yield Problem.of((kind, index, "mass_g"), text, f"at least {MIN_MASS_G:g}")


def _table_problems(playpen: PlaypenTables) -> Iterator[Problem]:
    width_mm, height_mm = playpen.arena.width_mm, playpen.arena.height_mm
    if playpen.arena.outline_mm:
        yield Problem.of(("arena", "table"), "arena: table with an outline_mm", "a rectangle for a table")
    for location, name, patch in _labelled({"patch": playpen.patches}):
        if patch.is_one_shape and any(find_overhangs(patch.footprint, width_mm, height_mm)):
            yield Problem.of(location, f"{name}: beyond the table's edge", "a patch on the table")


def _surface_problems(playpen: PlaypenTables) -> Iterator[Problem]:
    for name in playpen.surfaces:
        if name in BUILT_IN_SURFACES:
            expected = f"a name other than {', '.join(BUILT_IN_SURFACES)}"
            yield Problem.of(("surfaces", name), f"surfaces {name}: built in", expected)
    surfaces = {**BUILT_IN_SURFACES, **playpen.surfaces}
    parts = _labelled({**playpen.obstacles, "patch": playpen.patches})
    for location, name, part in chain([(("arena",), "arena", playpen.arena)], parts):
        if part.surface not in surfaces:
            text = f'{name}: surface = "{part.surface}": unknown'
            yield Problem.of((*location, "surface"), text, tuple(surfaces), part.surface)
    yield from _stripe_problems(playpen, tuple(surfaces))


def _stripe_problems(playpen: PlaypenTables, surfaces: tuple[str, ...]) -> Iterator[Problem]:
    """Yield stripes of unknown surfaces, and an excessive number of panels."""
    for location, name, part in chain([(("arena",), "arena", playpen.arena)], _labelled(playpen.obstacles)):
        for number, (_, surface) in enumerate(part.stripes, 1):
            if surface not in surfaces:
                text = f'{name}: stripes {number}: "{surface}": unknown'
                yield Problem.of((*location, "stripes"), text, surfaces, surface)
    if sum(1 for _ in islice(playpen.panels, PANEL_LIMIT + 1)) > PANEL_LIMIT:
        yield Problem.of((), f"stripes: more than {PANEL_LIMIT} panels", "wider or fewer stripes")


def _wall_problems(playpen: PlaypenTables) -> Iterator[Problem]:
    for wall_location, name, wall in _labelled(playpen.obstacles):
        if not isinstance(wall, Wall):
            continue
        location = *wall_location, "points_mm"
        for number, (x_mm, y_mm) in enumerate(wall.points_mm, 1):
            for value, limit in ((x_mm, playpen.arena.width_mm), (y_mm, playpen.arena.height_mm)):
                if value > limit:
                    text = f"{name}: points_mm {number}: {value:g}: outside the arena"
                    yield Problem.of(location, text, f"0 to {limit:g}", value)
        for number, (start, end) in enumerate(edges(wall.points_mm, closed=wall.closed), 1):
            if start == end:
                text = f"{name}: points_mm {number}: same as the next point"
                yield Problem.of(location, text, "each point once")


def _patch_problems(playpen: PlaypenTables, placed: bool) -> Iterator[Problem]:
    for location, name, patch in _labelled({"patch": playpen.patches}):
        if not patch.is_one_shape:
            text = f"{name}: neither disc nor rectangle"
            yield Problem.of(location, text, "radius_mm alone, or length_mm and width_mm")
        elif placed:
            yield from centre_problems(name, location, patch.footprint, playpen.arena)


def _lamp_problems(playpen: PlaypenTables) -> Iterator[Problem]:
    lighting = playpen.lighting
    if not lighting.min_angle_deg < lighting.max_angle_deg:
        text = f"lighting: max_angle_deg = {lighting.max_angle_deg:g}"
        expected = f"above min_angle_deg = {lighting.min_angle_deg:g}"
        yield Problem.of(("lighting", "max_angle_deg"), text, expected)
    for location, name, lamp in _labelled({"lamp": playpen.lamps}):
        if 0 < lamp.blink_period_s < SHORTEST_BLINK_S:
            text = f"{name}: blink_period_s = {lamp.blink_period_s:g}"
            yield Problem.of((*location, "blink_period_s"), text, f"0, or {SHORTEST_BLINK_S:g} to 3600")
        previous_end = 0.0
        for start, end in lamp.on_s:
            if not previous_end <= start < end:
                text = f"{name}: on_s = [{start:g}, {end:g}]"
                yield Problem.of((*location, "on_s"), text, f"times that rise, from {previous_end:g} on")
                break
            previous_end = end


def _robot_problems(playpen: PlaypenTables) -> Iterator[Problem]:
    """Yield the inconsistencies of the robots' keys."""
    spot_names = [spot.name for spot in playpen.spots]
    for location, robot_name, robot in _labelled({"robot": playpen.robots}):
        roms = robot.robot_model.roms
        if robot.rom in roms and (reason := roms[robot.rom].refusal_reason(robot.mode)):
            yield Problem((*location, "mode"), f"{robot_name}: mode = {robot.mode}: {reason}")
        for key, value, expected in find_unfit_keys(robot):
            text = f"{robot_name}: {key} = {value!r} with model = {robot.model!r}"
            yield Problem.of((*location, key), text, expected)
        try:
            find_turrets(robot.turrets)
        except TurretError as error:
            text = f"{robot_name}: turrets = {list(robot.turrets)}: {error}"
            yield Problem((*location, "turrets"), text)
        for name in robot.spots:
            if name not in spot_names:
                text = f'{robot_name}: spots: "{name}": unknown'
                yield Problem.of((*location, "spots"), text, tuple(spot_names), name)
    used_names = {name for robot in playpen.robots for name in robot.spots}
    if used_names and used_names <= set(spot_names) and not assign_spots(playpen, list):
        text = "robots: there is not a spot for each of them, clear of the others"
        yield Problem.of(("robot",), text, "a spot more")


def find_unfit_keys(robot: RobotEntry) -> Iterator[tuple[str, object, str]]:
    """Yield keys of a robot that do not fit its model: key, value and expected values."""
    roms = robot.robot_model.roms
    if robot.rom not in roms:
        yield "rom", robot.rom, " or ".join(roms)
    if robot.turrets and Feature.TURRETS not in robot.robot_model.features:
        yield "turrets", [*robot.turrets], "none"


def _name_problems(playpen: PlaypenTables) -> Iterator[Problem]:
    """Yield the names that two parts of any kinds share."""
    first_parts: dict[str, str] = {}
    for location, name, item in _labelled(playpen.tables):
        if item.name is not None and first_parts.setdefault(item.name, name) != name:
            text = f'{name}: name = "{item.name}": taken by {first_parts[item.name]}'
            yield Problem.of((*location, "name"), text, "a unique name")


def placed_parts(playpen: PlaypenTables) -> Iterator[PlacedPart]:
    """Yield all parts of a playpen that take up room, and its spots."""
    for kind, items in playpen.obstacles.items():
        for number, item in enumerate(items, 1):
            for footprint in item.footprints:
                yield PlacedPart(kind, number, item.name, footprint, 0, item.height_mm, item.movable)
    for number, item in enumerate(playpen.lamps, 1):
        low_mm, high_mm = item.z_mm - BULB_RADIUS_MM, item.z_mm + BULB_RADIUS_MM
        yield PlacedPart("lamp", number, item.name, item.footprint, low_mm, high_mm, False)
    for number, spot in enumerate(playpen.spots, 1):
        # As large as the largest robot that may start there, or a robot without turrets.
        bare = RobotEntry(x_mm=spot.x_mm, y_mm=spot.y_mm, heading_deg=spot.heading_deg)
        users = [at_spot(robot, spot) for robot in playpen.robots if spot.name in robot.spots] or [bare]
        largest = max((user.footprint for user in users), key=lambda disc: disc.radius_mm)
        tallest = max(user.body.height for user in users)
        yield PlacedPart("spot", number, spot.name, largest, 0, tallest * 1000, True)
    for number, item in enumerate(playpen.robots, 1):
        if not item.spots:
            yield PlacedPart("robot", number, item.name, item.footprint, 0, item.body.height * 1000, True)
