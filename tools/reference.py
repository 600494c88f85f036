"""Reference pages of the public functions and classes, from their docstrings.

They are generated, not kept in the repository: each edit of a docstring would change a megabyte of pages and
search index. A test generates them with every warning an error.
"""

import re
from importlib import import_module
from pathlib import Path

# Imported before pdoc, which forbids modules to start programs on import, as mujoco's window library does.
import mujoco as mujoco
import pdoc
import pdoc.render

from tools.command_table import command_line

ROOTS = (
    "khep_twin",
    "khep_twin.host",
    "khep_twin.playpen",
    "khep_twin.ports",
    "khep_twin.log",
    "khep_twin.episodes",
    "khep_twin.envs",
    "khep_twin.drawing",
    "khep_twin.shadow",
    "khep_twin.sensing",
    "khep_twin.board",
    "khep_twin.sweep",
    "khep_twin.lab.experiment",
    "khep_twin.lab.sensor_test",
    "khep_twin.lab.fit",
    "khep_twin.lab.challenge",
    "khep_twin.lab.conformance",
    "khep_twin.lab.dataset",
)
"""Packages that export their public names at the root."""

MODULES = (
    "khep_twin.host.commands",
    "khep_twin.lab.experiment.measures",
    "khep_twin.lab.experiment.run_statistics",
    "khep_twin.lab.experiment.series_statistics",
    "khep_twin.errors",
    "khep_twin.units",
)
"""Further public modules."""


def write(folder: Path) -> None:
    """Write the pages, which need no network when read.

    Args:
        folder: Folder of `index.html` and a page for each module.
    """
    pdoc.render.configure(
        docformat="google", show_source=False, include_undocumented=False, footer_text="khep_twin"
    )
    for root in ROOTS:
        package = import_module(root)
        for name in package.__all__:
            getattr(package, name)  # pdoc sees only what is loaded
    roots = (spec for root in ROOTS for spec in (root, rf"!{re.escape(root)}\..+"))
    pdoc.pdoc(*roots, *MODULES, output_directory=folder)


def main() -> None:
    """Write the pages into the folder of the command line."""
    parser = command_line(__doc__)
    parser.add_argument("folder", nargs="?", type=Path, default="docs/reference")
    folder = parser.parse_args().folder
    write(folder)
    print(f"reference  {folder}/index.html")
