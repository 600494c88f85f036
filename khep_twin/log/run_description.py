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
from khep_twin.log.decoding import printable
from khep_twin.log.entries import Entry, Label
from khep_twin.log.snapshots import RecorderState
from khep_twin.sensing import calibration
from khep_twin.world import World


class LogPrefix(NamedTuple):
    """Start of a run, copied from another log.

    Attributes:
        entries: Messages to copy, by chunk of the other log; empty for a run from time 0.
        state: State of the recorder after these messages; None for a run from time 0.
    """

    entries: Iterable[Sequence[Entry]] = ()
    state: RecorderState | None = None


@dataclass(frozen=True, slots=True)
class RunDescription:
    """Description of a run, in addition to that of its world.

    Attributes:
        settings: Configuration of the run, saved in a log as configuration.json.
        facts: Further metadata of the run.
        attachments: Further attachments by name.
        prefix: Start of the run, copied from another log; `facts` and `attachments` are then complete.
    """

    settings: Mapping[str, object]
    facts: Mapping[str, str] = field(default_factory=dict[str, str])
    attachments: Mapping[str, str] = field(default_factory=dict[str, str])
    prefix: LogPrefix | None = None

    def all_attachments(self, world: World) -> Mapping[str, str]:
        """Return all attachments by name, including those that describe the world."""
        if self.prefix is not None:
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
        """Return all metadata of the run, including that of the world."""
        if self.prefix is not None:
            return self.facts
        return {
            "playpen": world.playpen.name,
            "robots": ",".join(robot.name for robot in world.robots),
            **versions(),
            **self.facts,
            **self.settings,
        }


def versions() -> dict[str, str]:
    """Return the versions that may affect the last bits of a run: packages and type of machine."""
    return {
        "khep_twin": __version__,
        "mujoco": mujoco.__version__,
        "numpy": version("numpy"),
        "machine": f"{platform.system()} {platform.machine()}",
    }


def version_differences(label: Label) -> list[str]:
    """Return the differences between the versions of a log and those installed, a line each."""
    return [
        f"made with {key} {printable(label.metadata.get(key, 'unknown'))}, here is {value}"
        for key, value in versions().items()
        if label.metadata.get(key) != value
    ]
