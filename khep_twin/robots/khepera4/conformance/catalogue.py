"""Checks of a Khepera IV at a port, in the order in which they run."""

from khep_twin.lab.conformance.port.check import Catalogue, Check
from khep_twin.robots.khepera4.conformance import commands, grammar, motion

CHECKS: tuple[Check, ...] = tuple(
    value
    for module in (grammar, commands, motion)
    for value in vars(module).values()
    if isinstance(value, Check)
)
"""All checks, in the order of these modules."""

KHEPERA_4_CHECKS = Catalogue(CHECKS, counters="R")
