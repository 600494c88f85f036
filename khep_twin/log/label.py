"""Label of a log: what its run was, as metadata and attachments."""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from mcap.records import Metadata

from khep_twin.files.toml_files import NAME_WISH
from khep_twin.log.decoding import DecodeError, shown


@dataclass(frozen=True, slots=True)
class Label:
    """Metadata and attachments of a log.

    Attributes:
        metadata: Seed, versions, settings.
        attachments: Texts playpen.toml, scene.xml, configuration.json, calibration/*.toml, controller/*.py.
        robots: Names of the robots.
    """

    metadata: Mapping[str, str]
    attachments: Mapping[str, str]
    robots: tuple[str, ...]


def label_of(path: Path, metadata: Mapping[str, str], attachments: Mapping[str, str]) -> Label:
    """Return the label of a log; its metadata names the robots.

    Raises:
        LogError: The names are invalid.
    """
    try:
        return Label(metadata, attachments, robot_names(metadata["robots"]))
    except DecodeError as error:
        raise error.at(path, "metadata") from None


def run_facts(records: Iterable[Metadata]) -> dict[str, str]:
    """Return the metadata of the run."""
    return {key: text for each in records if each.name == "run" for key, text in each.metadata.items()}


def robot_names(text: str) -> tuple[str, ...]:
    """Return the names of a log's robots from its metadata.

    Raises:
        DecodeError: They are no valid names.
    """
    if not _NAMES.fullmatch(text):
        raise DecodeError(f"robots = {shown(text)}", f"names with commas between, each {NAME_WISH}")
    names = tuple(text.split(","))
    if len(set(names)) < len(names):
        raise DecodeError(f"robots = {shown(text)}", "each name once")
    return names


_NAMES = re.compile(r"[A-Za-z0-9_-]{1,64}(,[A-Za-z0-9_-]{1,64}){0,999}")
