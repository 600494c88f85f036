"""Broken builds of the host library and of network ports."""

from tools.simulate.mutants import Mutant

MUTANTS: dict[str, Mutant] = {}
