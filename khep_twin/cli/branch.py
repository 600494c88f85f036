"""`khep-twin branch`: a logged run resumed at a moment, to go on from there with something changed."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from khep_twin.cli.completion import controllers, logs
from khep_twin.cli.option_groups import grouped
from khep_twin.cli.options import (
    Faults,
    Force,
    check_apart,
    check_new,
    check_picture,
    tell_written,
    usage,
)
from khep_twin.cli.progress import of_part
from khep_twin.cli.progress import progress as progress_bar
from khep_twin.signals import stopping

if TYPE_CHECKING:
    from khep_twin.lab.experiment.branch import BranchPlan, Trajectory
    from khep_twin.log.recorded import BranchPoint


@dataclass(frozen=True, slots=True)
class ChangeOptions:
    """Options for a change of a run."""

    seed: Annotated[
        int | None,
        typer.Option(min=0, help="Draw from another seed; with --runs from this one, the next, and so on."),
    ] = None
    fault: Faults = None
    calibration: Annotated[
        str | None,
        typer.Option(help="Another calibration of the robots on the line: a shipped name, or a path."),
    ] = None
    set_values: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="TABLE.N.KEY=VALUE",
            help="Change the playpen, as often as wanted: block.3.x_mm=250 for the third [[block]].",
        ),
    ] = None

    def at(self, time_s: float, log: Path, robot: int | None) -> "BranchPoint":
        """Return the change of a log's run at a time [s]; `robot` is the one whose calibration changes."""
        from khep_twin.lab.experiment.branch import calibrations
        from khep_twin.log.recorded import BranchPoint

        return BranchPoint(
            round(time_s * 1e9),
            seed=self.seed,
            faults=tuple(self.fault or ()),
            edits=tuple(self.set_values or ()),
            calibrations=None if self.calibration is None else calibrations(log, self.calibration, robot),
        )


@grouped
def branch(
    *,
    log: Annotated[Path, typer.Argument(help="Log of the run, FILE.mcap.", autocompletion=logs)],
    at: Annotated[float, typer.Option(help="Moment from which to resume the run [s].")],
    output: Annotated[
        Path, typer.Option("--output", "-o", help="Log to write, with --runs NAME-001.mcap and so on.")
    ],
    controller: Annotated[
        str | None,
        typer.Option(
            help="Let this controller take over: a built-in one, or FILE.py[:NAME]; without, the recorded "
            "hosts go on.",
            autocompletion=controllers,
        ),
    ] = None,
    robot: Annotated[
        int | None,
        typer.Option(help="Robot of --controller and --calibration, counted from 0."),
    ] = None,
    change: ChangeOptions,
    seconds: Annotated[
        float | None, typer.Option(help="Go on for this time [s]; without, to the end of the log's run.")
    ] = None,
    cycles: Annotated[
        int | None, typer.Option(min=1, help="Go on for so many cycles of the controller.")
    ] = None,
    runs: Annotated[int, typer.Option(min=1, max=10_000, help="Number of branches, of a seed each.")] = 1,
    picture: Annotated[
        Path | None,
        typer.Option(help="Draw the paths in this PNG, SVG or PDF file; with --runs NAME.png by default."),
    ] = None,
    force: Force = False,
) -> None:
    """Resume a logged run at a moment, with a change.

    Controller, seed, fault, robot or playpen may be another.

    Up to the moment the new log is the old one's. Without --seconds or --cycles it ends when that does.
    """
    from khep_twin.lab.experiment.branch import BranchPlan
    from khep_twin.lab.experiment.controller_files import find_controller
    from khep_twin.lab.experiment.series_run import own_files
    from khep_twin.toolbox.form import as_toolbox_form

    found = None if controller is None else find_controller(controller, as_toolbox_form)
    if found is None and (cycles is not None or (robot is not None and change.calibration is None)):
        raise usage("--cycles and --robot are for a controller; expected --controller, too")
    if not 0 < at < 1e9 or (seconds is not None and not 0 < seconds < 1e9):
        raise usage("--at and --seconds are above 0 and finite")
    paths = own_files(output, runs)
    picture = picture or (output.with_suffix(".png") if runs > 1 else None)
    check_new(force, *paths, picture)
    check_picture(picture, output)
    check_apart([log], *paths, picture)
    plan = BranchPlan(log, change.at(at, log, robot), found, robot, seconds, cycles)
    trajectories = _run_branches(plan, controller, paths)
    if not trajectories:
        raise typer.Exit(130)
    if picture is not None:
        from khep_twin.drawing.map import save
        from khep_twin.lab.experiment.figures import draw_fan

        save(draw_fan(plan, trajectories), picture, force)
        typer.echo(f"picture  {picture}")
    tell_written("log", paths[: len(trajectories)])
    if len(trajectories) < runs:
        raise typer.Exit(130)


def _run_branches(plan: "BranchPlan", controller: str | None, paths: Sequence[Path]) -> "list[Trajectory]":
    """Run a branch for each path, of a seed each; return those that were run before the user stopped."""
    from khep_twin.lab.experiment.branch import branch as run_branch
    from khep_twin.lab.experiment.controller_files import find_controller
    from khep_twin.toolbox.form import as_toolbox_form

    first, runs = plan.change.seed, len(paths)
    trajectories: list[Trajectory] = []
    seeds = [first] if runs == 1 else [(1 if first is None else first) + number for number in range(runs)]
    found = plan.controller
    with stopping("ending this branch") as asked, progress_bar() as show:
        for number, path in enumerate(paths):
            if asked():
                break
            if number and controller is not None:  # a separate one for each branch
                found = find_controller(controller, as_toolbox_form)
            each = replace(plan, change=replace(plan.change, seed=seeds[number]), controller=found)
            shown = of_part(show, number, runs)
            trajectories.append(run_branch(each, path, progress=shown, stop=asked))
    return trajectories
