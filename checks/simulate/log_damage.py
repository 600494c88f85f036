"""Logs that a bad disk or a bad copy has damaged: they are refused with a reason, or read, and recovered."""

import random
import tempfile
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from checks.simulate.log_readings import read_in_every_way
from checks.simulate.simulation import Simulation, Violation
from khep_twin.errors import KhepTwinError
from khep_twin.log.recover import recover, summary


def damage(simulation: Simulation, path: Path, number: int, *, has_world: bool) -> None:
    """Damage a copy of a log in some places, read it in every way, and recover it.

    Args:
        simulation: Simulation.
        path: Path of a log.
        number: Number of its run.
        has_world: True for a twin's log.
    """
    # Not on the simulated disk, whose power cuts would bring the copy back.
    with tempfile.TemporaryDirectory(dir=simulation.folder.parent) as folder:
        copy, part = (Path(folder) / f"damaged.mcap{ending}" for ending in ("", ".part"))
        copy.write_bytes(_damaged(path.read_bytes(), simulation.rng("damage", number)))
        with _refused(simulation, copy):
            read_in_every_way(simulation, copy, has_world)
        copy.rename(part)
        with _refused(simulation, part):
            rescue = recover(part)
            summary(part, rescue)
            # A recovered file is a log, whatever its content is.
            read_in_every_way(simulation, rescue.path, False)
    simulation.count("logs damaged")


def _damaged(data: bytes, rng: random.Random) -> bytes:
    """Return a log with other bytes in some places, cut off, or with pieces missing."""
    changed = bytearray(data)
    for _ in range(rng.choice((1, 1, 3, 10))):
        at = rng.randrange(len(changed))
        match rng.randrange(5):
            case 0:
                changed[at] ^= 1 << rng.randrange(8)
            case 1:
                changed[at : at + 8] = rng.randbytes(8)
            case 2:
                changed[at : at + 512] = bytes(min(512, len(changed) - at))
            case 3:
                del changed[at : at + rng.randrange(1, 5000)]
            case _:
                del changed[max(at, 1) :]
        if not changed:
            break
    return bytes(changed)


@contextmanager
def _refused(simulation: Simulation, path: Path) -> Generator[None]:
    """Let a damaged log be refused, by one line that names it, or be read with differences."""
    try:
        yield
    except Violation:
        simulation.count("damaged logs that differ by the way of their reading")
    except KhepTwinError as error:
        if "\n" in str(error) or "damaged" not in str(error):
            simulation.violate("errors", f"a damaged log is refused by {error!r}")
        simulation.count("damaged logs refused")
    except Exception as error:
        raise Violation("errors", f"{path.name} is refused by {error!r}") from error
