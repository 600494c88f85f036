"""Broken builds of a served pseudo-terminal."""

from tools.simulate.mutants import Mutant

MUTANTS: dict[str, Mutant] = {}
