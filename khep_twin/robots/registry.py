"""Models of robots by name: those that ship, and those of other packages."""

from collections.abc import Container, Mapping
from functools import cache
from importlib.metadata import EntryPoint, entry_points

from khep_twin.board.rom import Rom
from khep_twin.errors import RobotModelError, choices
from khep_twin.lazy import load_plugins
from khep_twin.robots.model import GROUP, Dialect, Feature, RobotModel

DEFAULT = "khepera1"
"""Model of robots that a file or an option does not name."""

_SHIPPED = {
    "khepera1": "khepera.model:KHEPERA_1",
    "khepera2": "khepera.model:KHEPERA_2",
    "khepera4": "khepera4.model:KHEPERA_4",
}


@cache
def installed_models() -> Mapping[str, RobotModel]:
    """Return the models of all installed packages by name, those that ship first.

    Raises:
        RobotModelError: A package registers an object that is no model, or a name that is in use.
    """
    foreign = sorted(entry_points(group=GROUP), key=lambda entry: (entry.name, entry.value))
    return load_plugins([*_shipped_entries(), *foreign], RobotModel, RobotModelError, "robot")


@cache
def shipped_models() -> Mapping[str, RobotModel]:
    """Return the models that ship, by name."""
    return load_plugins(_shipped_entries(), RobotModel, RobotModelError, "robot")


def _shipped_entries() -> list[EntryPoint]:
    return [EntryPoint(name, f"khep_twin.robots.{reference}", GROUP) for name, reference in _SHIPPED.items()]


def find_model(name: str) -> RobotModel:
    """Return a model by its name.

    Raises:
        RobotModelError: No installed package has it.
    """
    models = installed_models()
    if name not in models:
        raise RobotModelError(f"model = {name!r}: unknown; {choices(name, models)}")
    return models[name]


def find_family(name: str) -> RobotModel:
    """Return a model by its name or by that of its family, of which it is the first.

    Raises:
        RobotModelError: No installed package has it.
    """
    shipped = _families_of(shipped_models())
    return shipped.get(name) or installed_families().get(name) or find_model(name)


def find_other_family(dialect: Dialect, versions_reply: str) -> RobotModel | None:
    """Return the first model of the family that identifies itself so; None for this dialect, or none."""
    if dialect.versions_reply.fullmatch(versions_reply):
        return None
    families = installed_families().values()
    matches = (model for model in families if model.dialect.versions_reply.fullmatch(versions_reply))
    return next(matches, None)


def installed_roms() -> Mapping[str, Rom]:
    """Return the versions of firmware of all models, by name."""
    return {name: rom for model in installed_models().values() for name, rom in model.roms.items()}


def default_model() -> RobotModel:
    """Return the model of robots that a file or an option does not name."""
    return shipped_models()[DEFAULT]


def installed_families() -> Mapping[str, RobotModel]:
    """Return the first model of each family."""
    return _families_of(installed_models())


def _families_of(models: Mapping[str, RobotModel]) -> Mapping[str, RobotModel]:
    families: dict[str, RobotModel] = {}
    for model in models.values():
        families.setdefault(model.family, model)
    return families


def titles_with(feature: Feature) -> str:
    """Return the titles of the models that support a use, for messages."""
    titles = [model.title for model in installed_models().values() if feature in model.features]
    return f"a {' or '.join(titles)}"


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
