"""One case of the simulation: scenario, seed, faults and build, as data; also of the regressions."""

import shlex
import tomllib
from collections.abc import Collection
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Self

import tomlkit

from checks.simulate.catalogue import mutants, scenarios
from checks.simulate.simulation import Outcome, simulate

SECONDS = 600.0
"""Simulated time of a case [s]."""


@dataclass(frozen=True, slots=True)
class Case:
    """A simulation that can be run again.

    Attributes:
        scenario: Name of the scenario.
        seed: Seed.
        seconds: Simulated time [s].
        mutant: Name of the broken build; empty for the product as it is.
        faults: Names of the faults that happen where they would; None for all.
        invariant: Name of the invariant that is violated; empty if none or unknown.
    """

    scenario: str
    seed: int
    seconds: float = SECONDS
    mutant: str = ""
    faults: tuple[str, ...] | None = None
    invariant: str = ""

    @classmethod
    def read(cls, path: Path) -> Self:
        """Read a case from a TOML file."""
        table = tomllib.loads(path.read_text(encoding="utf-8"))
        return cls(**{**table, "faults": None if "faults" not in table else tuple(table["faults"])})

    def write(self, path: Path) -> None:
        """Write it as a TOML file."""
        table = {name: getattr(self, name) for name in self.__slots__}
        text = tomlkit.dumps({name: value for name, value in table.items() if value not in (None, "")})
        path.write_text(text, encoding="utf-8")

    def run(self, allowed: Collection[str] | None = None) -> Outcome:
        """Run it, with other faults if they are given; return its outcome."""
        broken = mutants()[self.mutant].broken() if self.mutant else nullcontext()
        with broken:
            faults = self.faults if allowed is None else allowed
            return simulate(self.scenario, scenarios()[self.scenario], self.seed, self.seconds, faults)

    def sound(self) -> Self:
        """Return the same case of the product as it is."""
        return replace(self, mutant="")

    def command(self) -> str:
        """Return the command that runs it."""
        words = ["python", "-m", "checks", "simulate", "one", self.scenario, str(self.seed)]
        if self.seconds != SECONDS:
            words += ["--seconds", f"{self.seconds:g}"]
        if self.mutant:
            words += ["--mutant", self.mutant]
        if self.faults is not None:
            words += ["--faults", ",".join(self.faults)]
        return shlex.join(words)
