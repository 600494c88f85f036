"""Names that a package gives at its root, each loaded when it is first used.

A package lists them once, as type checkers read them:

    if TYPE_CHECKING:
        from khep_twin.world import World as World
    else:
        from khep_twin import lazy

        __getattr__, __dir__, __all__ = lazy.names(__name__)

`names` reads the same imports out of the package's source, so that `import khep_twin` loads none of them.
"""

import ast
import sys
from collections.abc import Callable
from importlib import import_module


def names(package: str) -> tuple[Callable[[str], object], Callable[[], list[str]], list[str]]:
    """Return `__getattr__`, `__dir__` and `__all__` of a package with imports under `if TYPE_CHECKING`."""
    module = sys.modules[package]
    with open(str(module.__file__), encoding="utf-8") as file:
        places = _places(file.read())

    def load(name: str) -> object:
        if name not in places:
            raise AttributeError(f"module {package!r} has no attribute {name!r}", name=name, obj=module)
        place, its_name = places[name]
        found = f"{place}.{its_name}"
        value = import_module(found) if place == package else getattr(import_module(place), its_name)
        setattr(module, name, value)
        return value

    return load, lambda: sorted({*vars(module), *places}), sorted(places)


def _places(source: str) -> dict[str, tuple[str, str]]:
    """Return the module of each name that is imported for type checkers alone, and its name there."""
    blocks = [node.body for node in ast.parse(source).body if isinstance(node, ast.If)]
    # Also those for one operating system, in an `if` within.
    nodes = [node for body in blocks for statement in body for node in ast.walk(statement)]
    imports = [node for node in nodes if isinstance(node, ast.ImportFrom)]
    return {
        alias.asname or alias.name: (str(node.module), alias.name) for node in imports for alias in node.names
    }
