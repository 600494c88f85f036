"""Three.js for the designer's page, as its package in the npm registry has it.

    python -m tools three-js [FOLDER]

writes its files, its licence, and the SHA-256 of each into a folder; `npm` fetches the package.
"""

import subprocess
import sys
import tarfile
from hashlib import sha256
from pathlib import Path
from tempfile import TemporaryDirectory

from tools.command_table import command_line

PACKAGE = "three@0.187.0"

FILES = {
    "three.module.js": "build/three.module.js",
    "three.core.js": "build/three.core.js",
    "three.orbit.js": "examples/jsm/controls/OrbitControls.js",
    "three.LICENSE": "LICENSE",
}
"""Names of the files here, and their places in the package."""

SUMS = "three.sha256"
"""File of the digests, as `sha256sum` writes and checks them."""


def fetch(folder: Path) -> None:
    """Write the files of the package, and their digests."""
    sums: list[str] = []
    with TemporaryDirectory() as place:
        subprocess.run(["npm", "pack", "--silent", PACKAGE], cwd=place, check=True, stdout=sys.stderr)
        with tarfile.open(next(Path(place).glob("*.tgz"))) as package:
            for name, path in FILES.items():
                member = package.extractfile(f"package/{path}")
                assert member is not None, path
                # Browsers know no package by its name alone.
                content = member.read().replace(b"from 'three';", b"from './three.module.js';")
                (folder / name).write_bytes(content)
                sums.append(f"{sha256(content).hexdigest()}  {name}\n")
    (folder / SUMS).write_text("".join(sums))


def main() -> None:
    """Fetch the files into a folder."""
    parser = command_line(__doc__)
    parser.add_argument("folder", nargs="?", type=Path, default="khep_twin/assets/web")
    fetch(parser.parse_args().folder)
