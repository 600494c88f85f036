"""Test of the built wheel: the ten short examples run in a new environment of each Python.

    make build
    python -m tools built-wheel [PYTHON …]

PYTHON is an interpreter; by default all installed ones of python3.11 to python3.14. Each takes about
three minutes and, until the end, 1.5 GB of disk space.
"""

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from tools.command_table import command_line

ROOT = Path(__file__).parents[1]
PYTHONS = [f"python3.{minor}" for minor in range(11, 15)]
PROGRAM = ROOT / "examples" / "00_first_lines.py"


def main() -> int:
    """Test each interpreter; return 1 if one fails, or without interpreters or wheel."""
    parser = command_line(__doc__)
    parser.add_argument("pythons", nargs="*", metavar="PYTHON")
    pythons = parser.parse_args().pythons or [python for python in PYTHONS if shutil.which(python)]
    wheels = sorted((ROOT / "dist").glob("*.whl"), key=lambda path: path.stat().st_mtime)
    if not wheels or not pythons:
        print("no wheel in dist: make build" if not wheels else "no interpreter", file=sys.stderr)
        return 1
    return int(any([not program_runs(python, wheels[-1]) for python in pythons]))


def program_runs(python: str, wheel: Path) -> bool:
    """Return whether the program runs with the wheel alone."""
    # The checkout and other environments must not be importable.
    alone = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")}
    with tempfile.TemporaryDirectory() as folder:
        program = shutil.copy(PROGRAM, folder)
        inside = str(Path(folder) / "environment" / "bin" / "python")
        for words in (
            [python, "-m", "venv", "environment"],
            [inside, "-m", "pip", "install", "-q", f"{wheel}[pictures,rl]"],
            [inside, program],
        ):
            process = subprocess.run(
                words, cwd=folder, env=alone, capture_output=True, text=True, check=False
            )
            if process.returncode != 0:
                print(f"{python}: {' '.join(words)}: {process.returncode}\n{process.stdout}{process.stderr}")
                return False
    print(f"{python}: {wheel.name}\n{process.stdout}", end="", flush=True)
    return True
