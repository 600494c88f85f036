"""Line numbers of tables and keys in a TOML file, which TOML readers do not report."""

import re
from collections.abc import Sequence

from khep_twin.errors import Location

_PART = r"""(?:[\w-]+|"[^"\n]*"|'[^'\n]*')"""
_PATH = rf"{_PART}(?:[ \t]*\.[ \t]*{_PART})*"
_HEADER = re.compile(rf"[ \t]*(\[\[?)[ \t]*({_PATH})[ \t]*\]\]?")
_KEY = re.compile(rf"[ \t]*({_PATH})[ \t]*=")
_TOKEN = re.compile(r"""\"\"\"|'''|"(?:\\.|[^"\\])*"|'[^']*'|[\[\]{}]|\#.*""")


class LineNumbers:
    """Line numbers of a file by location.

    Args:
        text: Text of a valid TOML file.
    """

    def __init__(self, text: str) -> None:
        self._lines: dict[Location, int] = {}
        counts: dict[Location, int] = {}
        table: Location = ()
        depth, closing_quotes = 0, ""
        for number, line in enumerate(text.split("\n"), 1):
            if not depth and not closing_quotes:
                if header := _HEADER.match(line):
                    table = self._header_location(_parts(header[2]), counts, is_array=header[1] == "[[")
                    self._lines.setdefault(table, number)
                    continue
                if key := _KEY.match(line):
                    parts = _parts(key[1])
                    for length in range(1, len(parts) + 1):
                        self._lines.setdefault((*table, *parts[:length]), number)
            depth, closing_quotes = _scan_line(line, depth, closing_quotes)

    def find(self, location: Sequence[str | int]) -> int | None:
        """Return the line number from 1, or that of the innermost enclosing table; None for the file."""
        path = tuple(location)
        while path and path not in self._lines:
            path = path[:-1]
        return self._lines.get(path)

    def _header_location(self, parts: Location, counts: dict[Location, int], *, is_array: bool) -> Location:
        """Return a header's location, with the indices in its arrays of tables."""
        location: Location = ()
        for index, part in enumerate(parts):
            location = (*location, part)
            if is_array and index == len(parts) - 1:
                counts[location] = counts.get(location, -1) + 1
            if location in counts:
                location = (*location, counts[location])
        return location


def _parts(path: str) -> Location:
    return tuple(part.strip().strip("\"'") for part in re.findall(_PART, path))


def _scan_line(line: str, depth: int, closing_quotes: str) -> tuple[int, str]:
    """Return the depth of brackets after a line, and the quotes that close a string which is open there."""
    position = 0
    while position < len(line):
        if closing_quotes:
            end = line.find(closing_quotes, position)
            if end < 0:
                return depth, closing_quotes
            position, closing_quotes = end + 3, ""
            continue
        token = _TOKEN.search(line, position)
        if token is None:
            break
        position = token.end()
        if token[0] in ('"""', "'''"):
            closing_quotes = token[0]
        elif token[0] in "[{":
            depth += 1
        elif token[0] in "]}":
            depth -= 1
    return depth, closing_quotes
