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
        depth, ending = 0, ""
        for number, line in enumerate(text.split("\n"), 1):
            if not depth and not ending:
                if header := _HEADER.match(line):
                    table = self._absolute(_parts(header[2]), counts, listed=header[1] == "[[")
                    self._lines.setdefault(table, number)
                    continue
                if key := _KEY.match(line):
                    parts = _parts(key[1])
                    for length in range(1, len(parts) + 1):
                        self._lines.setdefault((*table, *parts[:length]), number)
            depth, ending = _after(line, depth, ending)

    def of(self, location: Sequence[str | int]) -> int | None:
        """Return the line number from 1, or that of the innermost table around it; None for the file."""
        place = tuple(location)
        while place and place not in self._lines:
            place = place[:-1]
        return self._lines.get(place)

    def _absolute(self, parts: Location, counts: dict[Location, int], *, listed: bool) -> Location:
        """Return a header's location, with the numbers of the arrays of tables that it is in."""
        place: Location = ()
        for index, part in enumerate(parts):
            place = (*place, part)
            if listed and index == len(parts) - 1:
                counts[place] = counts.get(place, -1) + 1
            if place in counts:
                place = (*place, counts[place])
        return place


def _parts(path: str) -> Location:
    return tuple(part.strip().strip("\"'") for part in re.findall(_PART, path))


def _after(line: str, depth: int, ending: str) -> tuple[int, str]:
    """Return the depth in brackets at the next line, and the marks that would end a text open there."""
    place = 0
    while place < len(line):
        if ending:
            end = line.find(ending, place)
            if end < 0:
                return depth, ending
            place, ending = end + 3, ""
            continue
        token = _TOKEN.search(line, place)
        if token is None:
            break
        place = token.end()
        if token[0] in ('"""', "'''"):
            ending = token[0]
        elif token[0] in "[{":
            depth += 1
        elif token[0] in "]}":
            depth -= 1
    return depth, ending
