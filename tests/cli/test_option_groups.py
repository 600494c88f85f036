"""Groups of options: dataclasses spread over a command's signature."""

import inspect
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import pytest
import typer
from typer.testing import CliRunner

from khep_twin.cli.option_groups import LogOptions, RobotOptions, option_names, with_help
from khep_twin.cli.options import typed_options

ARGUMENTS: list[object] = []


@dataclass(frozen=True, slots=True)
class Size:
    """Group of options."""

    width_mm: Annotated[int, typer.Option(help="Width [mm].", min=1)] = 10
    tall: Annotated[bool, typer.Option("--tall", help="Make it tall.")] = False

    def __post_init__(self) -> None:
        if self.width_mm == 13:
            raise typer.Exit(2)


@with_help
def box(
    context: typer.Context,
    *,
    name: Annotated[str, typer.Argument(help="Name of the box.")] = "box",
    size: Size,
    colour: Annotated[str | None, typer.Option(help="Colour.")] = None,
) -> None:
    """Make a box."""
    ARGUMENTS[:] = [name, size, colour, typed_options(context)]


app = typer.Typer(rich_markup_mode=None)
app.command()(box)


def test_a_group_takes_what_is_typed_and_its_defaults() -> None:
    assert CliRunner().invoke(app, ["--tall", "--colour", "red", "mine"]).exit_code == 0
    assert ARGUMENTS == ["mine", Size(10, tall=True), "red", {"tall", "colour", "name"}]
    assert CliRunner().invoke(app, []).exit_code == 0
    assert ARGUMENTS == ["box", Size(), None, set()]


def test_options_stand_in_the_help_in_the_order_of_the_signature() -> None:
    help_text = CliRunner().invoke(app, ["--help"]).stdout
    assert "Make a box." in help_text
    assert help_text.index("--width-mm") < help_text.index("--tall") < help_text.index("--colour")
    assert [*inspect.signature(box).parameters] == ["context", "name", "width_mm", "tall", "colour"]


@pytest.mark.parametrize("typed", [["--width-mm", "0"], ["--width-mm", "13"], ["--size", "1"]])
def test_what_a_group_does_not_take_is_refused(typed: list[str]) -> None:
    ARGUMENTS[:] = []
    assert CliRunner().invoke(app, typed).exit_code == 2
    assert ARGUMENTS == []


def test_names_are_those_of_the_fields() -> None:
    assert option_names(Size, LogOptions) == {"width_mm", "tall", "log", "ignore_log_errors", "force"}


def test_the_robots_options_are_those_of_its_twin() -> None:
    options = RobotOptions(seed=3, mode="A", battery_used_min=5).options(robot=None)
    assert (options.seed, options.robot, options.mode, options.battery_used_min) == (3, None, 10, 5)
    assert RobotOptions().options().robot == 0


def test_a_log_that_fails_ends_the_run_unless_that_is_ignored(tmp_path: Path) -> None:
    assert LogOptions(tmp_path / "run.mcap").on_failure is None
    assert LogOptions(tmp_path / "run.mcap", ignore_log_errors=True).on_failure is not None
    with pytest.raises(typer.Exit):
        LogOptions(ignore_log_errors=True)
