"""Wheels of every locked package that pip would install, for each version of Python.

    python -m tools wheels [3.14 …]

pip is run for x86_64 Linux with glibc 2.28, whatever the interpreter. A wheel counts if its hash is in the
lock. The exit status is 1 if a package has none.
"""

import json
import re
import subprocess
import sys
import tempfile
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tools.command_table import command_line

ROOT = Path(__file__).parents[1]
VERSIONS = ["3.11", "3.12", "3.13", "3.14"]
LOCKS = ["requirements.lock", "requirements-dev.lock", "requirements-browser.lock"]
PLATFORMS = [f"manylinux_2_{minor}_x86_64" for minor in range(28, 4, -1)]
PLATFORMS += ["manylinux2014_x86_64", "manylinux2010_x86_64", "manylinux1_x86_64"]
MISSING = re.compile(r"No matching distribution found for ([\w.-]+)==")


def locked(version: str) -> dict[str, tuple[str, set[str]]]:
    """Return the locked version and hashes of each package that is for a version of Python, by name."""
    target = {
        "python_version": version,
        "python_full_version": f"{version}.0",
        "sys_platform": "linux",
        "platform_machine": "x86_64",
    }
    packages: dict[str, tuple[str, set[str]]] = {}
    for lock in LOCKS:
        for entry in re.split(r"\n(?=[A-Za-z0-9])", (ROOT / lock).read_text()):
            requirement = Requirement(entry.partition("\\")[0])
            if requirement.marker is None or requirement.marker.evaluate(target):
                [pin] = requirement.specifier
                packages[requirement.name] = pin.version, set(re.findall(r"--hash=(sha256:\w+)", entry))
    return packages


def wheels(version: str, pins: dict[str, str]) -> dict[str, tuple[str, str]]:
    """Return file name and hash of the wheel that pip selects for each pin, by package name."""
    pending = dict(pins)
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder, "report.json")
        command = [sys.executable, "-m", "pip", "install", "-q", "--disable-pip-version-check", "--dry-run"]
        command += ["--no-deps", "--only-binary", ":all:", "--python-version", version, "--target", folder]
        command += ["--ignore-installed", "--report", str(report), "-r", str(Path(folder, "pins.txt"))]
        command += [word for platform in PLATFORMS for word in ("--platform", platform)]
        while pending:
            lines = [f"{name}=={pin}\n" for name, pin in pending.items()]
            Path(folder, "pins.txt").write_text("".join(lines))
            process = subprocess.run(command, capture_output=True, text=True)
            if process.returncode == 0:
                break
            missing = MISSING.search(process.stderr)
            if missing is None:
                sys.exit(f"pip failed:\n{process.stderr}")
            del pending[missing[1]]
        else:
            return {}
        items = json.loads(report.read_text())["install"]
    wheel_by_name: dict[str, tuple[str, str]] = {}
    for item in items:
        url, hashes = item["download_info"]["url"], item["download_info"]["archive_info"]["hashes"]
        wheel_by_name[canonicalize_name(item["metadata"]["name"])] = (
            url.rpartition("/")[2],
            f"sha256:{hashes['sha256']}",
        )
    return wheel_by_name


def main() -> int:
    """Print a table for each version; return 1 if a package has none."""
    parser = command_line(__doc__)
    parser.add_argument("versions", nargs="*", default=VERSIONS, metavar="VERSION")
    n_missing = 0
    for version in parser.parse_args().versions:
        packages = locked(version)
        wheel_by_name = wheels(version, {name: pin for name, (pin, _) in packages.items()})
        n_locked = 0
        for name, (pin, hashes) in sorted(packages.items()):
            file, digest = wheel_by_name.get(name, ("", ""))
            n_locked += digest in hashes
            print(f"{version}  {name:26} {pin:18} {file if digest in hashes else 'NO LOCKED WHEEL'}")
        print(f"Python {version}: {n_locked} of {len(packages)} locked packages have a wheel")
        n_missing += len(packages) - n_locked
    return min(n_missing, 1)
