"""The tools: `python -m tools` lists them, `python -m tools NAME` runs one."""

import sys

from tools.command_table import run

TOOLS = {
    "record": "record",
    "commands": "command_docs",
    "reference": "reference",
    "site": "site",
    "tutorial": "tutorial",
    "pictures": "pictures",
    "mjcf": "mjcf",
    "three-js": "three_js",
    "wheels": "wheels",
    "built-wheel": "built_wheel",
}
"""Module of each name."""

if __name__ == "__main__":
    sys.exit(run("tools", TOOLS))
