"""`khep-twin playpen COMMAND`: playpen files listed, checked, compiled, drawn and imported."""

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from khep_twin import drawing
from khep_twin import playpen as playpens
from khep_twin.cli import completion
from khep_twin.cli.option_groups import with_help
from khep_twin.cli.options import Force, check_inputs, check_new, command_group
from khep_twin.errors import BitmapError, CalibrationError, KhepTwinError
from khep_twin.files.atomic import write_atomic
from khep_twin.files.drawings import write_drawing

if TYPE_CHECKING:
    from khep_twin.playpen.bitmap import BitmapPlaypen
    from khep_twin.playpen.bitmap_files import Bitmap

playpen_app = command_group("List, check, compile, draw and import playpens.")

SpotSeed = Annotated[int, typer.Option(help="Seed by which robots are placed on their spots.")]
PlaypenName = Annotated[
    str,
    typer.Argument(
        help="Name of a shipped playpen, or path of a playpen file.", autocompletion=completion.playpens
    ),
]
Output = Annotated[Path | None, typer.Option("--output", "-o", help="File to write.")]


@playpen_app.command("list")
def list_playpens() -> None:
    """List the shipped playpens, one per line."""
    names = playpens.names()
    for name in names:
        typer.echo(f"{name:{max(map(len, names))}}  {completion.summary(name)}")


@playpen_app.command()
def check(playpen: PlaypenName) -> None:
    """Check a playpen; print one line per problem."""
    from khep_twin.playpen.model import MANY_ROBOTS
    from khep_twin.sensing import calibration

    loaded_playpen = playpens.Playpen.load(playpen)
    for index, robot in enumerate(loaded_playpen.robots, 1):
        try:
            calibration.read_for(robot.calibration, robot.robot_model)
        except CalibrationError as error:
            raise CalibrationError(f"{playpen}: robot {index}: calibration = {error}") from None
    plurals = {kind: f"{kind}s" for kind in loaded_playpen.tables} | {"patch": "patches"}
    kind_counts = [(kind, len(items)) for kind, items in loaded_playpen.tables.items() if items]
    counts = [f"{count} {kind if count == 1 else plurals[kind]}" for kind, count in kind_counts]
    typer.echo(f"{loaded_playpen.name}: {', '.join(counts) or 'an empty arena'}: no problem")
    if len(loaded_playpen.robots) > MANY_ROBOTS:
        typer.echo(
            f"note: with more than {MANY_ROBOTS} robots a playpen compiles slowly, in a minute with 500, and "
            "runs many times slower than real time"
        )


@playpen_app.command()
def urdf(
    playpen: PlaypenName = "default",
    robot: Annotated[
        int | None, typer.Option(min=0, help="Number of the robot to write alone, from 0.")
    ] = None,
    output: Output = None,
    seed: SpotSeed = 0,
    force: Force = False,
) -> None:
    """Write a playpen, or one of its robots, as URDF.

    It goes to standard output by default. RViz and other tools of ROS show it. Links are the frames of
    `khep-twin export --ros2`.
    """
    from khep_twin.playpen_to_mjcf import to_spec
    from khep_twin.robots.model import robot_name
    from khep_twin.ros.robot_description import robot_description
    from khep_twin.ros.standard import StandardMessages
    from khep_twin.sensing.calibration import read_for

    check_inputs([playpen], output)
    check_new(force, output)
    loaded_playpen = playpens.at_spots(playpens.Playpen.load(playpen), seed)
    if robot is not None and robot >= (n_robots := len(loaded_playpen.robots)):
        expected = f"a number below {n_robots}" if n_robots else "a playpen with robots"
        raise KhepTwinError(f"--robot {robot}: number of robots = {n_robots}; expected {expected}")
    sensors = [
        frame
        for index, entry in enumerate(loaded_playpen.robots)
        for frame in StandardMessages(
            entry.robot_model, read_for(entry.calibration, entry.robot_model), robot_name(index)
        ).static_transforms()
    ]
    model = to_spec(loaded_playpen).compile()
    name = None if robot is None else robot_name(robot)
    _write(robot_description(model, sensors, name), output, "URDF", force)


@playpen_app.command("compile")
def compile_playpen(
    playpen: PlaypenName, output: Output = None, seed: SpotSeed = 0, force: Force = False
) -> None:
    """Write a playpen as MJCF, to standard output by default.

    MuJoCo loads the file without khep_twin.
    """
    from khep_twin.playpen_to_mjcf import to_mjcf

    check_inputs([playpen], output)
    check_new(force, output)
    _write(to_mjcf(playpens.at_spots(playpens.Playpen.load(playpen), seed)), output, "scene", force)


@playpen_app.command()
def draw(
    playpen: PlaypenName,
    output: Output = None,
    log: Annotated[
        Path | None, typer.Option(help="Also draw the paths of this log, of a run in the playpen.")
    ] = None,
    perspective: Annotated[
        bool, typer.Option("--perspective", help="Draw it as a camera above sees it; needs OpenGL.")
    ] = False,
    seed: SpotSeed = 0,
    force: Force = False,
) -> None:
    """Draw a playpen to scale, in NAME.png by default.

    The formats are PNG, SVG and PDF.
    """
    from khep_twin.log.reader import read_label, read_log

    loaded_playpen = playpens.Playpen.load(playpen)
    output_path = output or Path(f"{loaded_playpen.name}.png")
    check_inputs([playpen, *([] if log is None else [log])], output_path)
    check_new(force, output_path)
    if perspective:
        from khep_twin.drawing.render import render

        if log is not None:
            raise KhepTwinError("--log draws on a map; expected no --perspective")
        write_drawing(output_path, render(playpens.at_spots(loaded_playpen, seed), output_path), force)
    else:
        paths = ()
        if log is not None:
            if (name := read_label(log).metadata.get("playpen", loaded_playpen.name)) != loaded_playpen.name:
                raise KhepTwinError(f"{log}: a run in playpen {name}; expected one in {loaded_playpen.name}")
            paths = read_log(log).paths
        drawing.save(drawing.draw(playpens.at_spots(loaded_playpen, seed), paths), output_path, force)
    typer.echo(f"picture  {output_path}")


@playpen_app.command()
def schema(output: Output = None, force: Force = False) -> None:
    """Write the playpen format as a JSON schema, for editors.

    The default is standard output.
    """
    check_new(force, output)
    _write(json.dumps(playpens.schema(), indent=2) + "\n", output, "schema", force)


@playpen_app.command("random")
def random_playpen(
    density: Annotated[float, typer.Option(help="Part of the floor that obstacles cover, 0 to 0.1.")] = 0.06,
    seed: Annotated[int, typer.Option(help="Seed of the field.")] = 0,
    width_mm: Annotated[float, typer.Option(min=200, max=10_000, help="Width of the arena.")] = 1000,
    height_mm: Annotated[float, typer.Option(min=200, max=10_000, help="Height of the arena.")] = 1000,
    output: Output = None,
    force: Force = False,
) -> None:
    """Write a random field of obstacles as a playpen file.

    The default is standard output.
    """
    from khep_twin.playpen.random_obstacles import obstacle_field
    from khep_twin.randomness import stream

    check_new(force, output)
    field = obstacle_field(f"field-{seed}", width_mm, height_mm, density, stream(seed, "obstacle field"))
    options = f"--density {density!r} --seed {seed} --width-mm {width_mm!r} --height-mm {height_mm!r}"
    text = f"# khep-twin playpen random {options}\n\n{playpens.dump(field)}"
    details = f": {len(field.blocks)} blocks, {len(field.cylinders)} cylinders"
    _write(text, output, "playpen", force, details)


def _write(text: str, output: Path | None, kind: str, force: bool, details: str = "") -> None:
    """Write a text to a file and print `kind` and its path, or write the text to standard output."""
    if output is None:
        typer.echo(text, nl=False)
    else:
        write_atomic(output, text.encode("utf-8"), force)
        typer.echo(f"{kind:7}  {output}{details}")


@playpen_app.command("import")
@with_help
def import_bitmap(
    file: Annotated[Path, typer.Argument()],
    output: Output = None,
    mm_per_pixel: Annotated[float, typer.Option(metavar="MM")] = 1.0,
    flip: Annotated[bool | None, typer.Option("--flip/--no-flip")] = None,
    variable: str | None = None,
    solid: int | None = None,
    name: str | None = None,
    height_mm: Annotated[float, typer.Option(metavar="MM")] = 50.0,
    robot: Annotated[str | None, typer.Option(metavar="X,Y,HEADING")] = None,
    force: Force = False,
) -> None:
    """Make a playpen from a scanned or painted bitmap.

    The output is NAME.toml by default.

    Args:
        file: Scan of the Khepera Toolbox (MAT), or a picture (PNG, TIFF, GIF, BMP, PBM, JPEG).
        mm_per_pixel: Side of a pixel [mm].
        flip: Take the first row as the bottom: the default for a MAT file, as the toolbox scans upside down,
            but not for a picture.
        variable: Matrix of a MAT file to use; by default btmap1, or the only one.
        solid: Value of solid pixels (MAT); by default 44.
        name: Name of the playpen; by default the file's.
        height_mm: Height of the blocks [mm].
        robot: Pose of a robot [mm, mm, deg], or "none"; by default the free position nearest to the middle.
    """
    from khep_twin.files import toml_files
    from khep_twin.playpen import bitmap, bitmap_files

    check_inputs([file], output)
    name = name or re.sub(r"[^A-Za-z0-9_-]+", "-", file.stem)[:64].strip("-") or "imported"
    output_path = output or Path(f"{name}.toml")
    check_new(force, output_path)
    pose = None if robot in (None, "none") else _parse_pose(robot)
    image = bitmap_files.read(file, variable, solid)
    upside_down = image.is_scan if flip is None else flip
    try:
        result = bitmap.to_playpen(
            image.solid[::-1] if upside_down else image.solid,
            name,
            mm_per_pixel=mm_per_pixel,
            height_mm=height_mm,
            robot=pose,
            place_robot=robot is None,
        )
    except BitmapError as error:
        raise BitmapError(f"{file}: {error}") from None
    header = f"# Imported from {toml_files.format_value(file.name)} by khep-twin playpen import.\n\n"
    write_atomic(output_path, (header + playpens.dump(result.playpen)).encode("utf-8"), force)
    for line in _describe(image, result, upside_down, mm_per_pixel):
        typer.echo(line)
    typer.echo(f"robot    {_pose_text(result.playpen, is_requested=robot != 'none')}")
    typer.echo(f"playpen  {output_path}")


def _describe(image: "Bitmap", result: "BitmapPlaypen", upside_down: bool, pixel_mm: float) -> Iterator[str]:
    """Yield lines that describe a bitmap and the playpen made from it."""
    rows, columns = image.solid.shape
    borders, arena = result.borders, result.playpen.arena
    solid = f"{int(image.solid.sum())} of them solid"
    yield f"bitmap   {image.label}, {rows} x {columns} pixels of {pixel_mm:g} mm, {solid}"
    first_row = "bottom" if upside_down else "top"
    scan_note = " (the toolbox's scan turned the right way up)" if upside_down and image.is_scan else ""
    other_option = "--no-flip" if upside_down else "--flip"
    yield f"flip     its first row is the {first_row}{scan_note}; {other_option} for the other way"
    sides = {"left": borders.left, "right": borders.right, "bottom": borders.bottom, "top": borders.top}
    wall_widths = ", ".join(f"{pixels * pixel_mm:g} mm {side}" for side, pixels in sides.items())
    yield f"walls    {wall_widths}; now {arena.wall_thickness_mm:g} mm thick"
    yield f"arena    {arena.width_mm:g} x {arena.height_mm:g} mm within the walls"
    yield f"blocks   {len(result.playpen.blocks)}"


def _pose_text(playpen: "playpens.Playpen", is_requested: bool) -> str:
    """Return the first robot's pose as text, or why there is no robot."""
    for robot in playpen.robots:
        return f"at ({robot.x_mm:g}, {robot.y_mm:g}), heading {robot.heading_deg:g} degrees"
    return "none: no position is free" if is_requested else "none"


def _parse_pose(text: str) -> tuple[float, float, float]:
    """Return the numbers of X,Y,HEADING."""
    from khep_twin.lab.experiment.start_poses import parse_numbers

    if (numbers := parse_numbers(text, 3)) is None:
        raise BitmapError(f'--robot {text}: expected X,Y,HEADING, such as 300,250,90, or "none"')
    return numbers[0], numbers[1], numbers[2]
