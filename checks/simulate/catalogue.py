"""Scenarios and mutants of the simulation, by name."""

from importlib import import_module

from checks.simulate.mutants import Mutant
from checks.simulate.simulation import Scenario

MODULES = ("serving", "networking", "relaying", "recording", "files", "sweeping", "paging")
"""Modules of the scenarios."""


def scenarios() -> dict[str, Scenario]:
    """Return all scenarios by name."""
    return {name: scenario for module in MODULES for name, scenario in _of(module, "SCENARIOS").items()}


def mutants() -> dict[str, Mutant]:
    """Return all mutants by name."""
    return {name: mutant for module in MODULES for name, mutant in _of(module, "MUTANTS").items()}


def _of(module: str, name: str) -> dict:
    return getattr(import_module(f"checks.simulate.{module}"), name)
