"""Registration of the tasks with Gymnasium as khep_twin/NAME-v0, whichever package is imported first.

`import khep_twin` registers them at once if Gymnasium is loaded, else as soon as it is. Neither loads the
other: Gymnasium keeps names, and loads an environment when one is made. It reads no entry points of packages,
in no version of the extra `rl`, so a program imports `khep_twin`, or names it:
`gymnasium.make("khep_twin:khep_twin/Homing-v0")`.
"""

import sys
from collections.abc import Sequence
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

KHEPERA_4_TASKS = ("KheperaIVObstacleAvoidance", "KheperaIVLineFollowing")
"""Tasks of `khepera4.TASKS`, which needs Gymnasium."""

_REGISTRY = "gymnasium.envs.registration"


def register() -> None:
    """Register the tasks with Gymnasium, if it is loaded, or when it is."""
    if (known := sys.modules.get(_REGISTRY)) is None:
        if not any(isinstance(finder, _Waiting) for finder in sys.meta_path):
            sys.meta_path.insert(0, _Waiting())
        return
    from khep_twin.envs.tasks import TASKS

    registry: Any = known
    for task in TASKS:
        if (name := f"khep_twin/{task}-v0") not in registry.registry:
            registry.register(
                name,
                entry_point="khep_twin.envs.gymnasium:KheperaEnvironment",
                vector_entry_point="khep_twin.envs.gymnasium_vector:KheperaVectorEnvironment",
                kwargs={"task": task},
            )
    for task in KHEPERA_4_TASKS:
        if (name := f"khep_twin/{task}-v0") not in registry.registry:
            entry = "khep_twin.envs.khepera4:KheperaIVEnvironment"
            registry.register(name, entry_point=entry, kwargs={"task": task})


class _Waiting(MetaPathFinder, Loader):
    """Finder that lets others find and load Gymnasium's registry, registers the tasks then, and is gone."""

    def __init__(self) -> None:
        self._loader: Any = None

    def find_spec(
        self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        """Return the others' specification of the registry, with this as its loader; None for all else."""
        if fullname != _REGISTRY:
            return None
        others = (finder.find_spec(fullname, path, target) for finder in sys.meta_path if finder is not self)
        if (spec := next(filter(None, others), None)) is not None:
            self._loader, spec.loader = spec.loader, self
        return spec

    def create_module(self, spec: ModuleSpec) -> ModuleType | None:
        """Create the module as its own loader does."""
        return self._loader.create_module(spec)

    def exec_module(self, module: ModuleType) -> None:
        """Execute the module by its own loader, which it keeps, and register the tasks."""
        module.__loader__ = self._loader
        if module.__spec__ is not None:
            module.__spec__.loader = self._loader
        self._loader.exec_module(module)
        sys.meta_path.remove(self)
        register()
