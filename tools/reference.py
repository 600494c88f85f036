"""Reference pages of the public functions and classes, from their docstrings.

They are generated, not kept in the repository: each edit of a docstring would change a megabyte of pages and
search index. A test generates them with every warning an error.
"""

from pathlib import Path

# Imported before pdoc, which forbids modules to start programs on import, as mujoco's window library does.
import mujoco as mujoco
import pdoc
import pdoc.render

from tools.command_table import command_line

MODULES = (
    "khep_twin.host",
    "khep_twin.playpen",
    "khep_twin.lab.experiment.controllers",
    "khep_twin.lab.experiment.experiment",
    "khep_twin.lab.experiment.controller_files",
    "khep_twin.lab.experiment.series",
    "khep_twin.lab.experiment.series_run",
    "khep_twin.lab.experiment.series_files",
    "khep_twin.lab.experiment.series_statistics",
    "khep_twin.lab.experiment.run_statistics",
    "khep_twin.lab.experiment.measures",
    "khep_twin.lab.experiment.start_poses",
    "khep_twin.log.reader",
    "khep_twin.ports.protocol_khep",
    "khep_twin.ports.twin",
    "khep_twin.envs.tasks",
    "khep_twin.envs.task_episode",
    "khep_twin.errors",
    "khep_twin.units",
)
"""Public modules; all modules of a package."""


def write(folder: Path) -> None:
    """Write the pages, which need no network when read.

    Args:
        folder: Folder of `index.html` and a page for each module.
    """
    pdoc.render.configure(
        docformat="google", show_source=False, include_undocumented=False, footer_text="khep_twin"
    )
    pdoc.pdoc(*MODULES, output_directory=folder)


def main() -> None:
    """Write the pages where the command line says."""
    parser = command_line(__doc__)
    parser.add_argument("folder", nargs="?", type=Path, default="docs/reference")
    folder = parser.parse_args().folder
    write(folder)
    print(f"reference  {folder}/index.html")
