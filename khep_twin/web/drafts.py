"""Drafts of the page: playpens as JSON, valid or not, and their problems."""

import re
import unicodedata
from collections.abc import Iterator, Mapping
from contextlib import suppress

from khep_twin import playpen as playpens
from khep_twin.board.rom import Rom
from khep_twin.errors import CalibrationError, PlaypenError
from khep_twin.files import toml_files
from khep_twin.files.toml_files import choices_of
from khep_twin.playpen import Playpen
from khep_twin.playpen.parts import Lighting, RobotEntry, model_defaults
from khep_twin.playpen.surfaces import BUILT_IN_SURFACES
from khep_twin.robots.model import Feature, RobotModel
from khep_twin.robots.registry import installed_models
from khep_twin.sensing import calibration

Draft = dict[str, object]

BLANK = (
    'version = 1\nname = "{name}"\n\n[arena]\nwidth_mm = 600\nheight_mm = 500\n\n'
    "[[robot]]\nx_mm = 300\ny_mm = 250\nheading_deg = 90\n"
)
"""Text of a new playpen: the toolbox's four walls, and a robot in the middle [mm]."""


def name_of(stem: str) -> str:
    """Return a playpen's name for a file name: letters without accents, digits, '_' and '-'."""
    letters = (letter for letter in unicodedata.normalize("NFKD", stem) if not unicodedata.combining(letter))
    return re.sub("[^A-Za-z0-9_-]+", "-", "".join(letters))[:64].strip("-") or "playpen"


def blank(stem: str) -> Draft:
    """Return a new playpen for a file whose name without ending is `stem`."""
    name = name_of(stem)
    return draft_of(playpens.parse(BLANK.format(name=name), name))


def draft_of(playpen: Playpen) -> Draft:
    """Return a playpen for the page: all keys of its file, with tables of one kind as a list."""
    return playpen.model_dump(by_alias=True, exclude_none=True, mode="json")


def problems_of(draft: Mapping[str, object]) -> list[dict[str, object]]:
    """Return a draft's problems, as `playpen check` reports them: location and text."""
    return [
        {"place": [part for part in problem.location if part != "[key]"], "text": problem.text}
        for problem in toml_files.problems(Playpen, draft)
    ]


def playpen_of(draft: Mapping[str, object]) -> Playpen:
    """Return a draft as a playpen.

    Raises:
        PlaypenError: The draft is invalid; one line per problem.
    """
    name = str(draft.get("name", "draft"))[:64]
    return toml_files.check(Playpen, toml_files.freeze(draft), name, PlaypenError)


def text_of(draft: Mapping[str, object], base: str | None) -> str:
    """Return the text of a playpen file for a draft, with the comments of `base`.

    Raises:
        PlaypenError: The draft is invalid, or `base` cannot be edited.
    """
    playpen = playpen_of(draft)
    return playpens.edited(BLANK.format(name=playpen.name) if base is None else base, playpen)


def models() -> dict[str, object]:
    """Return each model's default keys, the values of its other keys, and whether it has turrets.

    `calibrations` are those with a name for its sensors, `modes` has the running modes of each ROM: number
    and description.
    """
    return {
        name: {
            "defaults": {**model_defaults(name), "calibration": model.calibration_name},
            "calibrations": list(_calibrations(model)),
            "modes": {version: _modes(rom) for version, rom in model.roms.items()},
            "has_turrets": Feature.TURRETS in model.features,
        }
        for name, model in installed_models().items()
    }


def key_choices() -> dict[str, object]:
    """Return the values of the keys that have a fixed set, by table and key."""
    return {
        f"{table}.{key}": values
        for table, kind in (("lighting", Lighting), ("robot", RobotEntry))
        for key, field in kind.model_fields.items()
        if (values := choices_of(field))
    }


def surfaces() -> dict[str, object]:
    """Return the built-in surfaces."""
    return {name: surface.model_dump(exclude_none=True) for name, surface in BUILT_IN_SURFACES.items()}


def _calibrations(model: RobotModel) -> Iterator[str]:
    """Yield the names of the built-in calibrations, and of the model's one, that fit a model."""
    for name in dict.fromkeys((*calibration.names(), model.calibration_name)):
        with suppress(CalibrationError):
            calibration.read_for(name, model)
            yield name


def _modes(rom: Rom) -> dict[int, str]:
    """Return a description of each running mode of a ROM that the twin has."""
    return {
        number: ", ".join(filter(None, [f"{mode.baud} baud", mode.function]))
        for number, mode in rom.modes.items()
        if not mode.refusal
    }
