"""The simulated disk, the files that programs replace on it, and the logs that runs record on it."""

import os
import random
from pathlib import Path

import pytest

from checks.simulate import files, recording, recording_mutants
from checks.simulate.disk import Disk
from checks.simulate.disk_files import DiskFile
from checks.simulate.simulation import Simulation, simulate

MUTANTS = {**files.MUTANTS, **recording_mutants.MUTANTS}
SCENARIOS = {**files.SCENARIOS, **recording.SCENARIOS}

CAUGHT = {
    "files written in place": (0, 100),
    "files renamed before they are whole": (0, 100),
    "files renamed before they are on the disk": (1, 100),
    "renames that a power cut takes back": (1, 100),
    "a short write is taken for whole": (0, 60),
    "logs are renamed before the summary": (1, 60),
    "a recovery drops the last piece": (1, 100),
    "a flush loses a line": (0, 60),
    "repetition repeats nothing": (0, 210),
}
"""Seed and simulated time [s] of some of the broken builds: those that are caught soonest."""


@pytest.mark.share(4)
@pytest.mark.parametrize(("name", "seed"), [("files", 1), ("files", 7), ("record", 1)])
def test_a_seed_finds_nothing_and_gives_the_same_outcome_again(name: str, seed: int) -> None:
    seconds = 100.0 if name == "record" else 600.0
    first = simulate(name, SCENARIOS[name], seed, seconds)
    assert first.violation is None
    assert first.faults
    assert first.counts["disk calls"] > 50
    assert simulate(name, SCENARIOS[name], seed, seconds) == first


@pytest.mark.share(3)
@pytest.mark.parametrize("name", CAUGHT)
def test_a_broken_build_is_caught(name: str) -> None:
    (seed, seconds), mutant = CAUGHT[name], MUTANTS[name]
    with mutant.broken():
        outcome = simulate(mutant.scenario, SCENARIOS[mutant.scenario], seed, seconds)
    assert outcome.invariant == mutant.invariant


def test_a_power_cut_loses_only_what_was_not_synchronized() -> None:
    lengths = set[int]()
    for seed in range(200):
        file = DiskFile(0)
        file.write(0, b"a" * 5000)
        file.synchronize()
        file.write(5000, b"b" * 5000)
        file.cut(random.Random(seed))
        lengths.add(len(file.content))
        assert file.content[:5000] == b"a" * 5000
        assert set(file.content[5000:]) <= set(b"b\0")
    assert {5000, 10000} <= lengths
    assert len(lengths) > 10


def test_names_survive_a_power_cut_in_their_order(tmp_path: Path) -> None:
    """The last rename is lost first; after an fsync of the folder, none is."""
    contents = set[tuple[str, ...]]()
    for seed in range(50):
        folder = tmp_path / str(seed)
        folder.mkdir()
        simulation = Simulation(seed, folder)
        disk = Disk(simulation)
        for name in ("one", "two"):
            os.close(disk.open(folder / name, os.O_CREAT | os.O_WRONLY))
            disk.call("rename", folder / name, folder / f"{name}.whole")
        disk.cut()
        assert disk.agrees()
        contents.add(tuple(sorted(path.name for path in folder.iterdir())))
    assert contents == {(), ("one",), ("one.whole",), ("one.whole", "two"), ("one.whole", "two.whole")}


def test_the_disk_does_what_the_machine_does_with_files_and_their_errors(tmp_path: Path) -> None:
    disk = Disk(Simulation(0, tmp_path))
    with pytest.raises(FileNotFoundError):
        disk.call("unlink", tmp_path / "none")
    with pytest.raises(FileNotFoundError):
        disk.open(tmp_path / "none", os.O_WRONLY)
    descriptor = disk.open(tmp_path / "file", os.O_CREAT | os.O_WRONLY)
    assert disk.write(descriptor, b"four") == 4
    disk.call("link", tmp_path / "file", tmp_path / "other")
    disk.call("ftruncate", descriptor, 2)
    os.close(descriptor)
    assert disk.agrees()
    assert (tmp_path / "other").read_bytes() == b"fo"
