"""Models of the robots of a log, and the widths of their channels."""

import json
from collections.abc import Collection, Mapping
from tomllib import TOMLDecodeError, loads
from typing import Any, cast

from khep_twin.robots.model import RobotModel, robot_name
from khep_twin.robots.registry import (
    DEFAULT,
    default_model,
    find_model,
    installed_families,
    is_installed,
    model_of_channels,
)

SAMPLED_CHANNELS = ("proximity", "ambient", "speed", "duty", "registers")
"""Channels of a robot that `RobotTrack` has an attribute for."""


def models_of(
    attachments: Mapping[str, str], robots: Collection[str], topics: Collection[str] = ()
) -> dict[str, RobotModel]:
    """Return the model of each robot of a log, by its playpen, that of its line, or its channels.

    Args:
        attachments: Attachments of the log, with "playpen.toml" where it has one; "configuration.json" of a
            line may name its model.
        robots: Names of the robots.
        topics: Topics of the log.
    """
    try:
        tables: Any = loads(attachments.get("playpen.toml", "")).get("robot")
    except (TOMLDecodeError, RecursionError):  # readers of the playpen report it
        tables = None
    entries: list[Any] = cast(list[Any], tables) if isinstance(tables, list) else []
    if not all(isinstance(entry, dict) for entry in entries):
        entries = []
    names = {robot_name(index): str(entry.get("model", DEFAULT)) for index, entry in enumerate(entries)}
    names = names or dict.fromkeys(robots, _line_model(attachments))
    models: dict[str, RobotModel] = {}
    for robot in robots:
        if is_installed(name := names.get(robot, "")):
            models[robot] = find_model(name)
        else:
            prefix = f"/{robot}/"
            channels = {topic.removeprefix(prefix) for topic in topics if topic.startswith(prefix)}
            models[robot] = model_of_channels(channels)
    return models


def _line_model(attachments: Mapping[str, str]) -> str:
    """Return the name of the model of a recorded line; empty for none."""
    try:
        settings: object = json.loads(attachments.get("configuration.json", ""))
    except (ValueError, RecursionError):
        return ""
    return str(cast(dict[str, object], settings).get("model", "")) if isinstance(settings, dict) else ""


def further_channels(model: RobotModel) -> list[str]:
    """Return the names of a model's channels that `RobotTrack` has no attribute for."""
    if model.family == default_model().family:
        return []
    return [name for name in model.channels if name not in SAMPLED_CHANNELS]


def channel_widths(name: str) -> tuple[int, ...]:
    """Return the numbers per message of a channel of `SAMPLED_CHANNELS`, for each family; (0,) for any."""
    if name not in SAMPLED_CHANNELS or name == "registers":
        return (0,)
    widths = (len(model.channels[name]) for model in installed_families().values() if name in model.channels)
    return tuple(dict.fromkeys(widths))
