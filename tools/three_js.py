"""Three.js for the designer's page: its npm package, bundled and minified by esbuild into one module.

    python -m tools three-js [FOLDER]

writes the module, its licence, and the SHA-256 of each into a folder; `npm` fetches both packages.
"""

import subprocess
import sys
from hashlib import sha256
from pathlib import Path
from tempfile import TemporaryDirectory

from tools.command_table import command_line

PACKAGES = "three@0.187.0", "esbuild@0.28.2"

ENTRY = "export * from 'three';\nexport { OrbitControls } from 'three/addons/controls/OrbitControls.js';\n"
"""Module whose exports the bundle has."""

FILES = {"three.min.js": "three.min.js", "three.LICENSE": "node_modules/three/LICENSE"}
"""Paths in the folder of the build, by the name of the shipped file."""

SUMS = "three.sha256"
"""File of the digests, as `sha256sum` writes and checks them."""


def build(folder: Path) -> None:
    """Write the module, its licence, and their digests."""
    sums: list[str] = []
    with TemporaryDirectory() as build_folder:
        (Path(build_folder) / "entry.js").write_text(ENTRY)
        esbuild = ["npx", "esbuild", "entry.js", "--bundle", "--minify", "--format=esm"]
        for command in (
            ["npm", "install", "--silent", "--no-save", *PACKAGES],
            [*esbuild, "--log-level=warning", "--outfile=three.min.js"],
        ):
            subprocess.run(command, cwd=build_folder, check=True, stdout=sys.stderr)
        for name, path in FILES.items():
            content = (Path(build_folder) / path).read_bytes()
            (folder / name).write_bytes(content)
            sums.append(f"{sha256(content).hexdigest()}  {name}\n")
    (folder / SUMS).write_text("".join(sums))


def main() -> None:
    """Build the files in a folder."""
    parser = command_line(__doc__)
    parser.add_argument("folder", nargs="?", type=Path, default="khep_twin/assets/web")
    build(parser.parse_args().folder)
