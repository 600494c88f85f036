"""Description of a run at the head of its log: attachments and metadata."""

import json
import platform
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib.metadata import version
from typing import NamedTuple

import mujoco

from khep_twin import __version__
from khep_twin import playpen as playpens
from khep_twin.log.entries import Entry
from khep_twin.log.snapshots import RecorderState
from khep_twin.sensing import calibration
from khep_twin.world import World


class Beginning(NamedTuple):
    """Beginning of a run that another log has.

    Attributes:
        entries: Messages of the beginning, in pieces as that log has them; none of a run that begins anew.
        state: State of its recorder after them; None likewise.
    """

    entries: Iterable[Sequence[Entry]] = ()
    state: RecorderState | None = None


@dataclass(frozen=True, slots=True)
class RunDescription:
    """Description of a run besides what its world says.

    Attributes:
        settings: Configuration of the run, kept in a log as configuration.json.
        facts: More metadata of the run.
        attachments: More texts to keep, by name.
        beginning: Beginning of the run, after which the world is; facts and attachments are then complete.
    """

    settings: Mapping[str, object]
    facts: Mapping[str, str] = field(default_factory=dict[str, str])
    attachments: Mapping[str, str] = field(default_factory=dict[str, str])
    beginning: Beginning | None = None

    def all_attachments(self, world: World) -> Mapping[str, str]:
        """Return the texts to keep, by name, which describe the world, too."""
        if self.beginning is not None:
            return self.attachments
        return {
            "playpen.toml": playpens.dump(world.playpen),
            "scene.xml": world.spec.to_xml(),
            "configuration.json": json.dumps(dict(self.settings), indent=2, sort_keys=True) + "\n",
            **{
                f"calibration/{robot.name}.toml": calibration.read(entry.calibration)[1]
                for robot, entry in zip(world.robots, world.playpen.robots, strict=True)
            },
            **self.attachments,
        }

    def all_facts(self, world: World) -> Mapping[str, object]:
        """Return the metadata of the run, the world's included."""
        if self.beginning is not None:
            return self.facts
        return {
            "playpen": world.playpen.name,
            "robots": ",".join(robot.name for robot in world.robots),
            **versions(),
            **self.facts,
            **self.settings,
        }


def versions() -> dict[str, str]:
    """Return all that the last bits of a run may depend on: packages and kind of machine."""
    return {
        "khep_twin": __version__,
        "mujoco": mujoco.__version__,
        "numpy": version("numpy"),
        "machine": f"{platform.system()} {platform.machine()}",
    }
