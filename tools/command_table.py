"""Command line of `checks`, `studies` and `tools`: `python -m PACKAGE NAME`; without a name it lists all."""

import argparse
import ast
import sys
from collections.abc import Mapping
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path

ROOT = Path(__file__).parents[1]
"""The checkout."""


def summary(module: str) -> str:
    """Return the first line of a module's docstring, without importing the module."""
    spec = find_spec(module)
    assert spec is not None
    assert spec.origin is not None, module
    text = ast.get_docstring(ast.parse(Path(spec.origin).read_text(encoding="utf-8"))) or ""
    return text.partition("\n")[0]


def run(package: str, modules: Mapping[str, str]) -> int:
    """Call `main` of the module that the command line names; list all modules without a name.

    Args:
        package: Name of the package that has the table.
        modules: Module of each name, within the package.

    Returns:
        Exit status.
    """
    name, *rest = sys.argv[1:] or [""]
    if name in modules:
        sys.argv = [f"python -m {package} {name}", *rest]
        return import_module(f"{package}.{modules[name]}").main() or 0
    width = max(map(len, modules))
    lines = [f"  {command:{width}}  {summary(f'{package}.{module}')}" for command, module in modules.items()]
    is_help = name in ("", "-h", "--help")
    print(f"usage: python -m {package} NAME [--help | OPTIONS]\n", *lines, sep="\n")
    if not is_help:
        print(f"\n{name}: no such name in {package}; expected one of those above", file=sys.stderr)
    return 0 if is_help else 2


def command_line(description: str | None) -> argparse.ArgumentParser:
    """Return a parser of the arguments after the name, with the module's docstring as the description."""
    return argparse.ArgumentParser(
        sys.argv[0], description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
