"""Checks of a robot or twin at a port, in the order in which they run."""

from khep_twin.lab.conformance.port import commands, grammar, gripper, motion, radio, vision
from khep_twin.lab.conformance.port.check import Catalogue, Check

CHECKS: tuple[Check, ...] = tuple(
    value
    for module in (grammar, commands, radio, motion, gripper, vision)
    for value in vars(module).values()
    if isinstance(value, Check)
)
"""All checks, in the order of these modules. A new module of checks is added here."""

KHEPERA_CHECKS = Catalogue(CHECKS, counters="H")
