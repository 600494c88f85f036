"""Models of robots by name: those that ship, and those of other packages."""

import re
import warnings
from collections.abc import Container, Iterable, Mapping
from functools import cache
from importlib import import_module
from importlib.metadata import EntryPoint, entry_points
from pkgutil import iter_modules

from khep_twin import robots
from khep_twin.board.rom import Rom
from khep_twin.errors import RobotModelError, choices
from khep_twin.lazy import load_plugins
from khep_twin.robots.model import GROUP, Dialect, Feature, RobotModel
from khep_twin.robots.model_checks import check_model

DEFAULT = "khepera1"
"""Model of robots that a file or an option does not name."""

_NUMBER = re.compile(r"\d+(\.\d+)?")

_failures: dict[str, RobotModelError] = {}
"""Errors of the models that cannot be used, by name."""


@cache
def installed_models() -> Mapping[str, RobotModel]:
    """Return the usable models of all installed packages by name, those that ship first.

    Another model has no effect on commands that do not need it, but one warning: `find_model` and
    `is_installed` raise its error.
    """
    models = dict(shipped_models())
    _failures.clear()
    for entry in sorted(entry_points(group=GROUP), key=lambda entry: (entry.name, entry.value)):
        try:
            (model,) = _load([entry]).values()
            check_model(model)
            if entry.name in models:
                raise RobotModelError(
                    f"robot {entry.name}: {entry.value}: the name is taken by another package"
                )
            models[entry.name] = model
        except RobotModelError as error:
            _failures[entry.name] = error
            warnings.warn(f"{error}; continuing without this model", stacklevel=2)
    return models


@cache
def shipped_models() -> Mapping[str, RobotModel]:
    """Return the models that ship, by name: the `MODELS` of each folder of `khep_twin.robots`."""
    folders = (module.name for module in iter_modules(robots.__path__) if module.ispkg)
    modules = (import_module(f"{robots.__name__}.{folder}.model") for folder in sorted(folders))
    return {model.name: model for module in modules for model in module.MODELS}


def _load(entries: Iterable[EntryPoint]) -> dict[str, RobotModel]:
    return load_plugins(entries, RobotModel, RobotModelError, "robot")


def is_installed(name: str) -> bool:
    """Return whether an installed package has a model.

    Raises:
        RobotModelError: It has one that cannot be used.
    """
    if name in installed_models():
        return True
    if name in _failures:
        raise _failures[name]
    return False


def find_model(name: str) -> RobotModel:
    """Return a model by its name.

    Raises:
        RobotModelError: No installed package has it, or it cannot be used.
    """
    models = installed_models()
    if not is_installed(name):
        raise RobotModelError(f"model = {name!r}: unknown; {choices(name, models)}")
    return models[name]


def find_family(name: str) -> RobotModel:
    """Return a model by its name or by that of its family, of which it is the first.

    Raises:
        RobotModelError: No installed package has it.
    """
    return _shipped_families().get(name) or installed_families().get(name) or find_model(name)


def find_replying_model(versions_reply: str) -> RobotModel | None:
    """Return the model that identifies itself so, the one with the nearest BIOS; None without one."""

    def difference(model: RobotModel) -> float:
        texts = next(iter(model.roms.values())).bios, versions_reply
        bios, version = (float(match[0]) if (match := _NUMBER.search(text)) else 0.0 for text in texts)
        return abs(bios - version)

    models = installed_models().values()
    matches = (model for model in models if model.dialect.versions_reply.fullmatch(versions_reply))
    return min(matches, key=difference, default=None)


def find_other_model(dialect: Dialect, versions_reply: str) -> RobotModel | None:
    """Return the model that identifies itself so; None for this dialect, or without one."""
    is_same = dialect.versions_reply.fullmatch(versions_reply)
    return None if is_same else find_replying_model(versions_reply)


def installed_roms() -> Mapping[str, Rom]:
    """Return the versions of firmware of all models, by name."""
    return {name: rom for model in installed_models().values() for name, rom in model.roms.items()}


def default_model() -> RobotModel:
    """Return the model of robots that a file or an option does not name."""
    return shipped_models()[DEFAULT]


def installed_families() -> Mapping[str, RobotModel]:
    """Return the first model of each family."""
    return _families_of(installed_models())


@cache
def _shipped_families() -> Mapping[str, RobotModel]:
    return _families_of(shipped_models())


def _families_of(models: Mapping[str, RobotModel]) -> Mapping[str, RobotModel]:
    families: dict[str, RobotModel] = {}
    for model in models.values():
        families.setdefault(model.family, model)
    return families


def model_refusal(name: str, feature: Feature) -> str:
    """Return the message for a model that does not support a use."""
    titles = [model.title for model in installed_models().values() if feature in model.features]
    return f"model = {name!r}; expected a {' or '.join(titles)} for {feature.value}"


def model_of_channels(channels: Container[str]) -> RobotModel:
    """Return the model whose robot has these channels in a log; the default one where several have.

    It is the family with the most channels that the default one lacks, all of which are present.
    """
    best_model, n_best = default_model(), 0
    for model in installed_families().values():
        further_channels = model.channels.keys() - default_model().channels.keys()
        if len(further_channels) > n_best and all(name in channels for name in further_channels):
            best_model, n_best = model, len(further_channels)
    return best_model
