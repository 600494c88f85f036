"""The built wheel in an empty environment of each Python, where the ten ways to begin must run.

    make build
    python -m tools built-wheel [PYTHON …]

PYTHON is an interpreter; by default those of python3.11 to python3.14 that are found. Each installs 1.5 GB
for a while, and compiles: about three minutes.
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
    """Try each interpreter; return 1 if one fails, or if there is none or no wheel."""
    parser = command_line(__doc__)
    parser.add_argument("pythons", nargs="*", metavar="PYTHON")
    pythons = parser.parse_args().pythons or [python for python in PYTHONS if shutil.which(python)]
    found = sorted((ROOT / "dist").glob("*.whl"), key=lambda path: path.stat().st_mtime)
    if not found or not pythons:
        print("no wheel in dist: make build" if not found else "no interpreter", file=sys.stderr)
        return 1
    return int(any([not begins(python, found[-1]) for python in pythons]))


def begins(python: str, wheel: Path) -> bool:
    """Return whether the program runs with the wheel alone."""
    # Neither the checkout nor another environment is to be seen.
    alone = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "VIRTUAL_ENV")}
    with tempfile.TemporaryDirectory() as folder:
        program = shutil.copy(PROGRAM, folder)
        inside = str(Path(folder) / "environment" / "bin" / "python")
        for words in (
            [python, "-m", "venv", "environment"],
            [inside, "-m", "pip", "install", "-q", f"{wheel}[pictures,rl]"],
            [inside, program],
        ):
            done = subprocess.run(words, cwd=folder, env=alone, capture_output=True, text=True, check=False)
            if done.returncode != 0:
                print(f"{python}: {' '.join(words)}: {done.returncode}\n{done.stdout}{done.stderr}")
                return False
    print(f"{python}: {wheel.name}\n{done.stdout}", end="", flush=True)
    return True
