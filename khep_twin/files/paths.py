"""Type of the paths that functions accept."""

from os import PathLike

StrPath = str | PathLike[str]
"""Path as a string or as a `pathlib.Path`; functions convert it to a `Path`."""
