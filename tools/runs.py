"""Pages of the site that play runs: `python -m tools site` makes them with the commands below."""

import io
import tempfile
from contextlib import chdir, redirect_stderr, redirect_stdout
from pathlib import Path

from khep_twin.cli.app import app

_ROOT = Path(__file__).parents[1]

RUNS = {
    "braitenberg": (
        "The run of the README: the robot's demonstration program among obstacles",
        ["run braitenberg --playpen obstacles --seconds 60 --seed 1 --log {log}"],
    ),
    "swarm": (
        "Twenty robots, of which the first drives by the demonstration program",
        ["run braitenberg --playpen swarm --seconds 10 --seed 1 --log {log}"],
    ),
    "line": (
        "A Khepera IV with the reference program of the challenge `line`",
        ["run khep_twin/assets/challenges/line.py --playpen arena4-line --seconds 15 --seed 1 --log {log}"],
    ),
    "shadow": (
        "A shadow that follows the first ten seconds of such a run by its serial line",
        [
            "run braitenberg --playpen obstacles --seconds 10 --seed 1 --log {folder}/robot.mcap",
            "shadow obstacles {folder}/robot.mcap -o {log}",
        ],
    ),
}
"""Runs by name: title, and commands that make the log."""

PAGES = {
    "docs/twin.md": "shadow",
    "docs/swarm.md": "swarm",
    "docs/challenges.md": "line",
    "docs/khepera4.md": "line",
}
"""Pages of the site below whose title a run is linked, by name."""


def write(target: Path) -> None:
    """Write a page for each run into a folder, and `index.md` with links to them."""
    target.mkdir(parents=True, exist_ok=True)
    lines = [
        "# Runs\n\nEach page plays a run: time line, 3-D, readings and transcript. A page is one file.\n"
    ]
    with tempfile.TemporaryDirectory() as folder:
        for name, (title, commands) in RUNS.items():
            log = Path(folder, f"{name}.mcap")
            for command in [*commands, f"view {{log}} --html {target.resolve()}/{name}.html"]:
                words = [word.format(log=log, folder=folder) for word in command.split(" ")]
                output = io.StringIO()
                with chdir(_ROOT), redirect_stdout(output), redirect_stderr(output):
                    app(words, standalone_mode=False)
            lines.append(f"- [{title}]({name}.html)")
    (target / "index.md").write_text("\n".join(lines) + "\n", encoding="utf-8")
