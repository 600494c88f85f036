"""The long checks: `python -m checks` lists them, `python -m checks NAME` runs one."""

import sys

from tools.command_table import run

CHECKS = {
    "night": "night.runner",
    "simulate": "simulate.command",
    "fuzz-board": "fuzz.board",
    "fuzz-files": "fuzz.files",
    "fuzz-logs": "fuzz.logs",
    "fuzz-log-uses": "fuzz.log_uses",
    "fuzz-page": "fuzz.page",
    "fuzz-rfc2217": "fuzz.rfc2217",
    "edges": "edges",
    "branches": "branches",
    "recordings": "recordings",
    "determinism": "determinism",
    "day": "day",
    "kills": "kills",
    "worker-kills": "worker_kills",
    "signals": "signals",
    "pyserial": "pyserial_suite",
    "mutants": "mutants.command",
}
"""Module of each name."""

if __name__ == "__main__":
    sys.exit(run("checks", CHECKS))
