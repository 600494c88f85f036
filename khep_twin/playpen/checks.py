"""Checks across a playpen's parts: surfaces exist, robots are consistent, and all have room."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import chain, islice
from typing import cast

from khep_twin.board.rom import ROMS
from khep_twin.board.turrets import find
from khep_twin.errors import Location, PlaypenError, Problem, TurretError
from khep_twin.playpen.footprint import overlap, sticks_out
from khep_twin.playpen.overlap import Thing, beyond, label, placement_problems
from khep_twin.playpen.parts import BULB_RADIUS_MM, MODELS, SHORTEST_BLINK_S, RobotEntry, Spot
from khep_twin.playpen.polygon import edges
from khep_twin.playpen.stripes import PANEL_LIMIT, Stripe
from khep_twin.playpen.surfaces import BUILT_IN_SURFACES
from khep_twin.playpen.tables import PlaypenTables


def playpen_problems(
    playpen: PlaypenTables, recorded: bool = False, placed: bool = True
) -> Iterator[Problem]:
    """Yield the problems of a playpen whose keys are valid one by one.

    Args:
        playpen: Playpen to check.
        recorded: True if a run took place in it already: the height of its walls is then not checked.
        placed: Whether to check that all have room.
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
        placement_problems(list(things(playpen)), playpen.arena) if placed else (),
    )


def require_kheperas(playpen: PlaypenTables, what: str) -> None:
    """Raise a `PlaypenError` where a robot is no Khepera or Khepera II, which `what` is only for."""
    for number, robot in enumerate(playpen.robots, 1):
        if not robot.body.in_core:
            found = f"{playpen.name}: robot {number}: model = {robot.model!r}"
            raise PlaypenError(f"{found}; expected a Khepera or Khepera II for {what}")


def at_spot(robot: RobotEntry, spot: Spot) -> RobotEntry:
    """Return a robot that stands at a spot."""
    return robot.model_copy(update={"x_mm": spot.x_mm, "y_mm": spot.y_mm, "heading_deg": spot.heading_deg})


def assigned(
    playpen: PlaypenTables, order: Callable[[Sequence[str]], Sequence[str]]
) -> list[RobotEntry] | None:
    """Return the robots, each with spots at one of them, clear of the others; None if that is impossible.

    Args:
        playpen: Playpen with robots and spots.
        order: Function that orders a robot's spots for the search.
    """
    spots = {spot.name: spot for spot in playpen.spots}
    robots = list(playpen.robots)
    drawn = [index for index, robot in enumerate(robots) if robot.spots]
    tries = {index: [spots[name] for name in order(robots[index].spots)] for index in drawn}
    taken = [robot.footprint for robot in robots if not robot.spots]
    n_fixed, steps = len(taken), 1
    left = [iter(tries[index]) for index in drawn[:1]]
    while left:
        index = drawn[len(left) - 1]
        del taken[n_fixed + len(left) - 1 :]
        for spot in left[-1] if steps < _ASSIGNMENT_LIMIT else ():
            robot = at_spot(robots[index], spot)
            footprint = robot.footprint
            if not any(overlap(other, footprint) for other in taken):
                robots[index] = robot
                taken.append(footprint)
                break
        else:
            left.pop()
            continue
        if len(left) == len(drawn):
            return robots
        steps += 1
        left.append(iter(tries[drawn[len(left)]]))
    return None if drawn else robots


_ASSIGNMENT_LIMIT = 20_000
"""Most placements of robots at spots that are tried."""


def completed(data: dict[str, object]) -> dict[str, object]:
    """Return a file's content with the keys of robots that follow from their spots and their model."""
    spots = {str(spot.get("name")): spot for spot in _tables(data, "spot")}
    robots: list[dict[str, object]] = []
    for robot in _tables(data, "robot"):
        known = [spots[name] for name in map(str, _items(robot, "spots")) if name in spots]
        follows = following(str(robot.get("model")), known)
        if not known and _items(robot, "spots"):
            # Wrong names are reported later.
            follows |= {"x_mm": 0.0, "y_mm": 0.0, "heading_deg": 0.0}
        robots.append({**follows, **robot})
    return {**data, "robot": tuple(robots)} if robots else data


def following(model: str, spots: Sequence[Mapping[str, object]]) -> dict[str, object]:
    """Return the keys of a robot that follow from its model and its spots, if the file does not have them."""
    first: Mapping[str, object] = spots[0] if spots else {}
    place = {key: first[key] for key in ("x_mm", "y_mm", "heading_deg") if key in first}
    return {**MODELS.get(model, {}), **place}


def _tables(data: dict[str, object], kind: str) -> list[dict[str, object]]:
    """Return an array of tables of a file; empty if it is something else."""
    items = _items(data, kind)
    tables = [cast(dict[str, object], item) for item in items if isinstance(item, dict)]
    return tables if len(tables) == len(items) else []


def _items(data: dict[str, object], key: str) -> tuple[object, ...]:
    """Return an array of a file; empty if it is something else."""
    found = data.get(key)
    return cast(tuple[object, ...], found) if isinstance(found, tuple) else ()


LOWEST_WALL_MM, LOWEST_WALL_WITH_TURRET_MM = 15.0, 30.0
"""Lowest walls of an arena with bare robots, and with turrets [mm]. At full speed,
7 of 42 drives of 20 s ended beyond walls of 8 mm, 2 beyond 10 mm, none beyond 12 and 15 mm; with a gripper,
which is top-heavy, 7 beyond 12 mm and 2 beyond 15 mm (measured)."""


THINNEST_WALL_MM, LIGHTEST_G = 10.0, 5.0
"""Least thickness of an arena's walls [mm] and mass of movable objects [g] if there is a robot. In 2,000
random drives of 10 s a cylinder was pressed through walls of 1 to 3 mm in four, of 1 g also through 10 mm in
one of 1,000; from 5 g and 10 mm on, in none (measured)."""


def _arena_problems(playpen: PlaypenTables) -> Iterator[Problem]:
    for index, block in enumerate(playpen.blocks):
        if block.ramp and (block.movable or block.stripes):
            place = label("block", index + 1, block.name)
            yield Problem.of(
                ("block", index, "ramp"), f"{place}: ramp, movable or striped", "a ramp that is neither"
            )
    if playpen.arena.table:
        yield from _table_problems(playpen)
        return
    height_mm, turrets = playpen.arena.wall_height_mm, any(robot.turrets for robot in playpen.robots)
    lowest_mm = LOWEST_WALL_WITH_TURRET_MM if turrets else LOWEST_WALL_MM
    if playpen.robots and height_mm < lowest_mm:
        what = "a robot with a turret topples over it" if turrets else "a robot drives over it"
        found = f"arena: wall_height_mm = {height_mm:g}: {what} at full speed"
        yield Problem.of(("arena", "wall_height_mm"), found, f"at least {lowest_mm:g}")
    thickness_mm = playpen.arena.wall_thickness_mm
    movable = [
        (kind, index, item)
        for kind, items in playpen.objects.items()
        for index, item in enumerate(items)
        if item.movable and playpen.robots
    ]
    if movable and thickness_mm < THINNEST_WALL_MM:
        found = f"arena: wall_thickness_mm = {thickness_mm:g}: a robot presses movable things through it"
        yield Problem.of(("arena", "wall_thickness_mm"), found, f"at least {THINNEST_WALL_MM:g}")
    for kind, index, item in movable:
        if item.mass_g < LIGHTEST_G:
            found = f"{kind} {index + 1}: mass_g = {item.mass_g:g}: a robot presses it through walls"
            yield Problem.of((kind, index, "mass_g"), found, f"at least {LIGHTEST_G:g}")


def _table_problems(playpen: PlaypenTables) -> Iterator[Problem]:
    width_mm, height_mm = playpen.arena.width_mm, playpen.arena.height_mm
    if playpen.arena.outline_mm:
        yield Problem.of(("arena", "table"), "arena: table with an outline_mm", "a rectangle for a table")
    for index, patch in enumerate(playpen.patches):
        if patch.is_one_shape and any(sticks_out(patch.footprint, width_mm, height_mm)):
            place = label("patch", index + 1, patch.name)
            yield Problem.of(("patch", index), f"{place}: beyond the table's edge", "a patch on the table")


def _surface_problems(playpen: PlaypenTables) -> Iterator[Problem]:
    for name in playpen.surfaces:
        if name in BUILT_IN_SURFACES:
            wanted = f"a name other than {', '.join(BUILT_IN_SURFACES)}"
            yield Problem.of(("surfaces", name), f"surfaces {name}: built in", wanted)
    known = {**BUILT_IN_SURFACES, **playpen.surfaces}
    users: list[tuple[Location, str, str]] = [(("arena",), "arena", playpen.arena.surface)]
    for kind, items in {**playpen.objects, "wall": playpen.walls, "patch": playpen.patches}.items():
        for index, item in enumerate(items):
            users.append(((kind, index), label(kind, index + 1, item.name), item.surface))
    for location, place, surface in users:
        if surface not in known:
            found = f'{place}: surface = "{surface}": unknown'
            yield Problem.of((*location, "surface"), found, tuple(known), surface)
    yield from _stripe_problems(playpen, tuple(known))


def _stripe_problems(playpen: PlaypenTables, known: tuple[str, ...]) -> Iterator[Problem]:
    """Yield stripes of unknown surfaces, and too many stripes."""
    striped: list[tuple[Location, str, Sequence[Stripe]]] = [(("arena",), "arena", playpen.arena.stripes)]
    for kind, items in {**playpen.objects, "wall": playpen.walls}.items():
        for index, item in enumerate(items):
            striped.append(((kind, index), label(kind, index + 1, item.name), item.stripes))
    for location, place, stripes in striped:
        for number, (_, surface) in enumerate(stripes, 1):
            if surface not in known:
                found = f'{place}: stripes {number}: "{surface}": unknown'
                yield Problem.of((*location, "stripes"), found, known, surface)
    if sum(1 for _ in islice(playpen.panels, PANEL_LIMIT + 1)) > PANEL_LIMIT:
        yield Problem.of((), f"stripes: more than {PANEL_LIMIT} panels", "wider or fewer stripes")


def _wall_problems(playpen: PlaypenTables) -> Iterator[Problem]:
    for index, wall in enumerate(playpen.walls):
        place, location = label("wall", index + 1, wall.name), ("wall", index, "points_mm")
        for number, (x_mm, y_mm) in enumerate(wall.points_mm, 1):
            for value, limit in ((x_mm, playpen.arena.width_mm), (y_mm, playpen.arena.height_mm)):
                if value > limit:
                    found = f"{place}: points_mm {number}: {value:g}: outside the arena"
                    yield Problem.of(location, found, f"0 to {limit:g}", value)
        for number, (start, end) in enumerate(edges(wall.points_mm, closed=wall.closed), 1):
            if start == end:
                found = f"{place}: points_mm {number}: same as the next point"
                yield Problem.of(location, found, "each point once")


def _patch_problems(playpen: PlaypenTables, placed: bool) -> Iterator[Problem]:
    for index, patch in enumerate(playpen.patches):
        told = label("patch", index + 1, patch.name)
        if not patch.is_one_shape:
            found = f"{told}: neither disc nor rectangle"
            yield Problem.of(("patch", index), found, "radius_mm alone, or length_mm and width_mm")
        elif placed:
            yield from beyond(told, ("patch", index), patch.footprint, playpen.arena)


def _lamp_problems(playpen: PlaypenTables) -> Iterator[Problem]:
    lighting = playpen.lighting
    if not lighting.min_angle_deg < lighting.max_angle_deg:
        found = f"lighting: max_angle_deg = {lighting.max_angle_deg:g}"
        wanted = f"above min_angle_deg = {lighting.min_angle_deg:g}"
        yield Problem.of(("lighting", "max_angle_deg"), found, wanted)
    for index, lamp in enumerate(playpen.lamps):
        if 0 < lamp.blink_period_s < SHORTEST_BLINK_S:
            found = f"{label('lamp', index + 1, lamp.name)}: blink_period_s = {lamp.blink_period_s:g}"
            yield Problem.of(("lamp", index, "blink_period_s"), found, f"0, or {SHORTEST_BLINK_S:g} to 3600")
        last = 0.0
        for start, end in lamp.on_s:
            if not last <= start < end:
                found = f"{label('lamp', index + 1, lamp.name)}: on_s = [{start:g}, {end:g}]"
                yield Problem.of(("lamp", index, "on_s"), found, f"times that rise, from {last:g} on")
                break
            last = end


def _robot_problems(playpen: PlaypenTables) -> Iterator[Problem]:
    """Yield the inconsistencies of the robots' keys."""
    known = [spot.name for spot in playpen.spots]
    for index, robot in enumerate(playpen.robots):
        place = label("robot", index + 1, robot.name)
        if reason := ROMS[robot.rom].refused(robot.mode):
            yield Problem(("robot", index, "mode"), f"{place}: mode = {robot.mode}: {reason}")
        for key, value, wanted in unfit(robot):
            found = f"{place}: {key} = {value!r} with model = {robot.model!r}"
            yield Problem.of(("robot", index, key), found, wanted)
        try:
            find(robot.turrets)
        except TurretError as error:
            yield Problem(("robot", index, "turrets"), f"{place}: turrets = {list(robot.turrets)}: {error}")
        for name in robot.spots:
            if name not in known:
                found = f'{place}: spots: "{name}": unknown'
                yield Problem.of(("robot", index, "spots"), found, tuple(known), name)
    if all(name in known for robot in playpen.robots for name in robot.spots) and not assigned(playpen, list):
        if any(robot.spots for robot in playpen.robots):
            yield Problem.of(
                ("robot",), "robots: there is not a spot for each of them, clear of the others", "a spot more"
            )


def unfit(robot: RobotEntry) -> Iterator[tuple[str, object, str]]:
    """Yield keys of a robot that do not fit its model: key, value, and what is expected."""
    own = MODELS[robot.model]["rom"]
    if (robot.rom == "kh4server") != (own == "kh4server"):
        yield "rom", robot.rom, own if own == "kh4server" else "that of a Khepera"
    if own == "kh4server" and robot.turrets:
        yield "turrets", [*robot.turrets], "none"


def _name_problems(playpen: PlaypenTables) -> Iterator[Problem]:
    """Yield the names that two parts have, of whatever kind."""
    first: dict[str, str] = {}
    for kind, items in playpen.tables.items():
        for index, item in enumerate(items):
            place = label(kind, index + 1, item.name)
            if item.name is not None and first.setdefault(item.name, place) != place:
                found = f'{place}: name = "{item.name}": taken by {first[item.name]}'
                yield Problem.of((kind, index, "name"), found, "a unique name")


def things(playpen: PlaypenTables) -> Iterator[Thing]:
    """Yield all parts of a playpen, and the spots where robots may start."""
    for kind, items in playpen.objects.items():
        for number, item in enumerate(items, 1):
            yield Thing(kind, number, item.name, item.footprint, 0, item.height_mm, item.movable)
    for number, wall in enumerate(playpen.walls, 1):
        for footprint in wall.footprints:
            yield Thing("wall", number, wall.name, footprint, 0, wall.height_mm, False)
    for number, item in enumerate(playpen.lamps, 1):
        low_mm, high_mm = item.z_mm - BULB_RADIUS_MM, item.z_mm + BULB_RADIUS_MM
        yield Thing("lamp", number, item.name, item.footprint, low_mm, high_mm, False)
    for number, spot in enumerate(playpen.spots, 1):
        # As large as the largest robot that may start on it; a bare robot if none may.
        bare = RobotEntry(x_mm=spot.x_mm, y_mm=spot.y_mm, heading_deg=spot.heading_deg)
        users = [at_spot(robot, spot) for robot in playpen.robots if spot.name in robot.spots] or [bare]
        largest = max((user.footprint for user in users), key=lambda disc: disc.radius_mm)
        tallest = max(user.body.height for user in users)
        yield Thing("spot", number, spot.name, largest, 0, tallest * 1000, True)
    for number, item in enumerate(playpen.robots, 1):
        if not item.spots:
            yield Thing("robot", number, item.name, item.footprint, 0, item.body.height * 1000, True)
