"""Tests of the suite at their full length: soak, leavings, model, docs-blocks, and those marked long.

    python -m checks tests                      all of them, one after the other
    python -m checks tests soak model           some

The suite takes a share of each. The exit status is 1 if one fails.
"""

import argparse
import os
import subprocess
import sys
from typing import NamedTuple


class Part(NamedTuple):
    """Part of the suite.

    Attributes:
        words: Options and paths for pytest.
        environment: Variables that give the full length.
    """

    words: str
    environment: dict[str, str]


PARTS = {
    "soak": Part(
        "tests/ports/test_chaos.py tests/ports/test_random_hosts.py",
        {"KHEP_RUBBISH_SECONDS": "60", "KHEP_OPENINGS": "2000"},
    ),
    "leavings": Part("-s tests/ports/test_leaving_hosts.py -k stale", {"KHEP_LEAVINGS": "1000"}),
    "model": Part("tests/board/test_board_against_model.py", {"KHEP_COMMANDS": "50000"}),
    "docs-blocks": Part("-rP tests/test_docs_blocks.py", {"KHEP_DOCS": "all"}),
    "long": Part("-m long tests", {}),
}


def main() -> int:
    """Run the parts; return 1 if one fails."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("parts", nargs="*", choices=[*PARTS, []], metavar="PART", help=", ".join(PARTS))
    failed = [name for name in parser.parse_args().parts or PARTS if run(PARTS[name])]
    print(f"failed: {', '.join(failed)}" if failed else "all passed")
    return 1 if failed else 0


def run(part: Part) -> int:
    """Run a part; return pytest's exit status."""
    command = [sys.executable, "-m", "pytest", "-q", "-n", "0", *part.words.split()]
    return subprocess.run(command, env={**os.environ, **part.environment}, check=False).returncode
