"""`khep-twin branch`: a logged run, resumed from a given time with a change."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from khep_twin import drawing
from khep_twin.cli.completion import controllers, logs
from khep_twin.cli.option_groups import with_help
from khep_twin.cli.options import Faults, Force, check_inputs, check_new, check_picture, print_files, usage
from khep_twin.cli.progress import part_bar
from khep_twin.cli.progress import progress as progress_bar
from khep_twin.process.signals import stopping

if TYPE_CHECKING:
    from khep_twin.lab.experiment.branch import BranchPlan, Trajectory
    from khep_twin.log.recorded import BranchPoint


@dataclass(frozen=True, slots=True)
class ChangeOptions:
    """Options that change a resumed run.

    Attributes:
        seed: Draw from another seed; with --runs, branch n uses this seed + n - 1.
        calibration: Use another calibration for the robots on the line: a shipped name, or a path.
        set_values: Change the playpen: block.3.x_mm=250 for the third [[block]]; repeatable.
    """

    seed: Annotated[int | None, typer.Option(min=0)] = None
    fault: Faults = None
    calibration: str | None = None
    set_values: Annotated[list[str] | None, typer.Option("--set", metavar="TABLE.N.KEY=VALUE")] = None

    def branch_point(self, time_s: float, log: Path, robot: int | None) -> "BranchPoint":
        """Return the branch point of a log at a time [s]; `robot` is the one whose calibration changes."""
        from khep_twin.lab.experiment.branch import calibration_texts
        from khep_twin.log.recorded import BranchPoint

        name = self.calibration
        return BranchPoint(
            round(time_s * 1e9),
            seed=self.seed,
            faults=tuple(self.fault or ()),
            edits=tuple(self.set_values or ()),
            calibrations=None if name is None else calibration_texts(log, name, robot),
        )


@with_help
def branch(
    *,
    log: Annotated[Path, typer.Argument(autocompletion=logs)],
    time_s: Annotated[float, typer.Option("--at")],
    output: Annotated[Path, typer.Option("--output", "-o")],
    controller: Annotated[str | None, typer.Option(autocompletion=controllers)] = None,
    robot: int | None = None,
    change: ChangeOptions,
    seconds: float | None = None,
    cycles: Annotated[int | None, typer.Option(min=1)] = None,
    runs: Annotated[int, typer.Option(min=1, max=10_000)] = 1,
    picture: Path | None = None,
    force: Force = False,
) -> None:
    """Resume a logged run at a given time, with a change.

    The controller, seed, faults, calibration or playpen may change.

    Up to that time the new log equals the old one. Without --seconds or --cycles, both end at the same time.

    Args:
        log: Log of the run, FILE.mcap.
        time_s: Time from which to resume the run [s].
        output: Log to write; with --runs, NAME-001.mcap and so on.
        controller: Replace the recorded hosts by this controller: a built-in one, or FILE.py[:NAME]; by
            default they are replayed.
        robot: Robot of --controller and --calibration, counted from 0.
        seconds: Continue for this time [s]; by default to the end of the log's run.
        cycles: Continue for this number of controller cycles.
        runs: Number of branches, with a seed each.
        picture: Draw the paths in this PNG, SVG or PDF file; NAME.png by default with --runs.
    """
    from khep_twin.lab.experiment.branch import BranchPlan
    from khep_twin.lab.experiment.controller_files import find_controller
    from khep_twin.lab.experiment.series_run import run_files
    from khep_twin.toolbox.form import as_toolbox_form

    program = None if controller is None else find_controller(controller, as_toolbox_form)
    if program is None and (cycles is not None or (robot is not None and change.calibration is None)):
        raise usage("--cycles and --robot are for a controller; expected --controller with them")
    if not 0 < time_s < 1e9 or (seconds is not None and not 0 < seconds < 1e9):
        raise usage("--at and --seconds are above 0 and finite")
    paths = run_files(output, runs)
    picture = picture or (output.with_suffix(".png") if runs > 1 else None)
    check_new(force, *paths, picture)
    check_picture(picture, output)
    check_inputs([log], *paths, picture)
    plan = BranchPlan(log, change.branch_point(time_s, log, robot), program, robot, seconds, cycles)
    trajectories = _run_branches(plan, controller, paths)
    if not trajectories:
        raise typer.Exit(130)
    if picture is not None:
        from khep_twin.lab.experiment.figures import draw_fan

        drawing.save(draw_fan(plan, trajectories), picture, force)
        typer.echo(f"picture  {picture}")
    print_files("log", paths[: len(trajectories)])
    if len(trajectories) < runs:
        raise typer.Exit(130)


def _run_branches(plan: "BranchPlan", controller: str | None, paths: Sequence[Path]) -> "list[Trajectory]":
    """Run one branch per path, each with its seed; return the paths of the robots in those that ran."""
    from khep_twin.lab.experiment.branch import branch as run_branch
    from khep_twin.lab.experiment.controller_files import find_controller
    from khep_twin.toolbox.form import as_toolbox_form

    seed, runs = plan.change.seed, len(paths)
    trajectories: list[Trajectory] = []
    seeds = [seed] if runs == 1 else [(1 if seed is None else seed) + number for number in range(runs)]
    program = plan.controller
    with stopping("ending this branch") as stop, progress_bar() as show:
        for number, path in enumerate(paths):
            if stop():
                break
            if number and controller is not None:  # a separate one for each branch
                program = find_controller(controller, as_toolbox_form)
            variant = replace(plan, change=replace(plan.change, seed=seeds[number]), controller=program)
            show_part = part_bar(show, number, runs)
            trajectories.append(run_branch(variant, path, progress=show_part, stop=stop))
    return trajectories
