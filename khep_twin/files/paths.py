"""Paths as functions take them."""

from os import PathLike

StrPath = str | PathLike[str]
"""Path as a string or as a `pathlib.Path`; a function makes it a `Path` as it begins."""
