"""The reference, `make reference`: pages of the public functions and classes, out of their docstrings.

They are made, not kept in the repository: each edit of a docstring would change a megabyte of pages and
search index. A test makes them with every warning an error.
"""

import sys
from pathlib import Path

# Before pdoc, under which no module may start a program when it is imported, as mujoco's window library does.
import mujoco as mujoco
import pdoc
import pdoc.render

MODULES = (
    "khep_twin.host",
    "khep_twin.playpen",
    "khep_twin.lab.experiment.controllers",
    "khep_twin.lab.experiment.experiment",
    "khep_twin.lab.experiment.series",
    "khep_twin.lab.experiment.series_files",
    "khep_twin.lab.experiment.series_statistics",
    "khep_twin.lab.experiment.run_statistics",
    "khep_twin.lab.experiment.measures",
    "khep_twin.lab.experiment.start_poses",
    "khep_twin.log.reader",
    "khep_twin.ports.protocol_khep",
    "khep_twin.ports.twin",
    "khep_twin.rollout.screening",
    "khep_twin.envs.tasks",
    "khep_twin.envs.trial",
    "khep_twin.errors",
    "khep_twin.units",
)
"""What programs may rely on; of a package all its modules."""


def write(folder: Path) -> None:
    """Writes the pages; they need no network when they are read.

    Args:
        folder: for `index.html` and a page for each module.
    """
    pdoc.render.configure(
        docformat="google", show_source=False, include_undocumented=False, footer_text="khep_twin"
    )
    pdoc.pdoc(*MODULES, output_directory=folder)


if __name__ == "__main__":
    write(Path(sys.argv[1]))
