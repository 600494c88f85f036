"""Lazy imports: public names of a package, each loaded on its first use, and objects of installed packages.

A package lists them once, as type checkers read them:

    if TYPE_CHECKING:
        from khep_twin.world import World as World
    else:
        from khep_twin import lazy

        __getattr__, __dir__, __all__ = lazy.names(__name__)

`names` reads the same imports from the package's source, so `import khep_twin` loads none of these modules.
"""

import ast
import reprlib
import sys
from collections.abc import Callable, Iterable
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, TypeVar

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint


class Named(Protocol):
    """Object that a package offers."""

    @property
    def name(self) -> str:
        """Name, that of its entry point."""
        ...


Plugin = TypeVar("Plugin", bound=Named)


def load_plugins(
    entries: "Iterable[EntryPoint]",
    kind: type[Plugin],
    error_type: type[Exception],
    title: str,
    *,
    is_valid: Callable[[Plugin], bool] = lambda plugin: True,
    expected: str = "",
) -> dict[str, Plugin]:
    """Return the objects of entry points by name.

    Args:
        entries: Entry points, in the order of the result.
        kind: Class of the objects.
        error_type: Class of the errors.
        title: Kind of object, for messages.
        is_valid: Function that checks an object.
        expected: Its requirement, for messages.

    Raises:
        error_type: A package registers another object, or a name that is in use.
    """
    plugins: dict[str, Plugin] = {}
    for entry in entries:
        text = f"{title} {entry.name}: {entry.value}"
        plugin = load_entry(entry, text, error_type)
        if isinstance(plugin, kind) and plugin.name != entry.name:
            expected_name = f"expected {entry.name!r}, the name of its entry point"
            raise error_type(f"{text} has name = {plugin.name!r}; {expected_name}")
        if not isinstance(plugin, kind) or not is_valid(plugin):
            raise error_type(f"{text} is {reprlib.repr(plugin)}; expected a {kind.__name__}{expected}")
        if plugins.setdefault(plugin.name, plugin) is not plugin:
            raise error_type(f"{text}: the name is taken by another package")
    return plugins


def load_entry(entry: "EntryPoint", text: str, error_type: type[Exception]) -> object:
    """Return the object of an entry point; `text` names it in the error.

    Raises:
        error_type: Its module cannot be imported, or it lacks the object.
    """
    try:
        return entry.load()
    except (ImportError, AttributeError) as error:
        raise error_type(f"{text} cannot be loaded: {error}") from error
    except Exception as error:  # the package's module may raise any error, for example a SyntaxError
        raise error_type(f"{text} cannot be loaded: {type(error).__name__}: {error}") from error


def names(
    package: str, further_sources: str = ""
) -> tuple[Callable[[str], object], Callable[[], list[str]], list[str]]:
    """Return `__getattr__`, `__dir__` and `__all__` of a package with imports under `if TYPE_CHECKING`.

    Args:
        package: Name of the package.
        further_sources: Pattern of further files whose imports count, relative to the folder of this module.
    """
    module = sys.modules[package]
    further_paths = sorted(Path(__file__).parent.glob(further_sources)) if further_sources else []
    imports: dict[str, tuple[str, str]] = {}
    for path in (*further_paths, Path(str(module.__file__))):
        imports |= _lazy_imports(path.read_text("utf-8"))

    def load(name: str) -> object:
        if name not in imports:
            raise AttributeError(f"module {package!r} has no attribute {name!r}", name=name, obj=module)
        source, attribute = imports[name]
        path = f"{source}.{attribute}"
        value = import_module(path) if source == package else getattr(import_module(source), attribute)
        setattr(module, name, value)
        return value

    return load, lambda: sorted({*vars(module), *imports}), sorted(imports)


def _lazy_imports(source: str) -> dict[str, tuple[str, str]]:
    """Return module and attribute of each name that the source imports for type checkers."""
    blocks = [node.body for node in ast.parse(source).body if isinstance(node, ast.If)]
    # Imports for one operating system stand in a nested `if`.
    nodes = [node for body in blocks for statement in body for node in ast.walk(statement)]
    imports = [node for node in nodes if isinstance(node, ast.ImportFrom)]
    return {
        alias.asname or alias.name: (str(node.module), alias.name) for node in imports for alias in node.names
    }
