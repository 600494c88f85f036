"""Registration of the tasks with Gymnasium as khep_twin/NAME-v0, whichever package is imported first.

`import khep_twin` registers them immediately if Gymnasium is imported, or when it is imported later. Neither
imports the other: Gymnasium stores names, and imports an environment in `make`. No Gymnasium version of the
extra `rl` reads entry points of packages, so a program imports `khep_twin`, or names it:
`gymnasium.make("khep_twin:khep_twin/Homing-v0")`.
"""

import dataclasses
import sys
from collections.abc import Mapping, Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from gymnasium.envs.registration import EnvSpec

_REGISTRY = "gymnasium.envs.registration"

_TIME_OPTIONS = frozenset({"task", "seconds", "period_ns"})
"""Options on which the number of steps of an episode depends."""


def register() -> None:
    """Register the tasks with Gymnasium now, or when it is imported."""
    if (module := sys.modules.get(_REGISTRY)) is None:
        if not any(isinstance(finder, _RegistrationFinder) for finder in sys.meta_path):
            sys.meta_path.insert(0, _RegistrationFinder())
        return
    from khep_twin.envs.tasks import TASKS
    from khep_twin.robots.registry import installed_models

    registry: Any = module
    for task in (*TASKS, *(name for model in installed_models().values() for name in model.tasks)):
        if (name := f"khep_twin/{task}-v0") not in registry.registry:
            registry.register(
                name,
                entry_point="khep_twin.envs.gymnasium:KheperaEnvironment",
                vector_entry_point="khep_twin.envs.gymnasium_vector:KheperaVectorEnvironment",
                kwargs={"task": task},
            )


class TimeLimitedSpec:
    """An environment whose `spec` has its time limit as `max_episode_steps`, which learning libraries read.

    Gymnasium's `make` sets a spec without one: the limit depends on the options, and needs no wrapper.
    """

    max_episode_steps: int
    _spec: Any = None

    @property
    def spec(self) -> Any:
        """Gymnasium's specification; None if `make` did not create the environment."""
        return self._spec

    @spec.setter
    def spec(self, spec: Any) -> None:
        limit = {"max_episode_steps": self.max_episode_steps}
        self._spec = None if spec is None else dataclasses.replace(spec, **limit)


def remove_stale_limit(spec: "str | EnvSpec", options: Mapping[str, object]) -> "str | EnvSpec":
    """Return a spec of a task without its limit in steps if options change the time; an id unchanged.

    Gymnasium would end the episodes of the new environment at the limit of the previous one.
    """
    if isinstance(spec, str) or options.keys().isdisjoint(_TIME_OPTIONS):
        return spec
    if not spec.id.startswith("khep_twin/"):
        return spec
    arguments = {name: value for name, value in spec.kwargs.items() if name != "max_episode_steps"}
    return dataclasses.replace(spec, max_episode_steps=None, kwargs=arguments)


class _RegistrationFinder(MetaPathFinder, Loader):
    """Finder that registers the tasks after the import of Gymnasium's registry, and then removes itself."""

    def __init__(self) -> None:
        self._loader: Any = None

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return the registry's spec by other finders, with this as its loader; None for other modules."""
        if fullname != _REGISTRY:
            return None
        specs = (finder.find_spec(fullname, path, target) for finder in sys.meta_path if finder is not self)
        if (spec := next(filter(None, specs), None)) is not None:
            self._loader, spec.loader = spec.loader, self
        return spec

    def create_module(self, spec: ModuleSpec) -> ModuleType | None:
        """Create the module by its original loader."""
        return self._loader.create_module(spec)

    def exec_module(self, module: ModuleType) -> None:
        """Execute the module by its original loader, restore that, and register the tasks."""
        module.__loader__ = self._loader
        if module.__spec__ is not None:
            module.__spec__.loader = self._loader
        self._loader.exec_module(module)
        sys.meta_path.remove(self)
        register()
