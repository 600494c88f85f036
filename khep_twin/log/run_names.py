"""Names of logs that are shown side by side."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from khep_twin.files.atomic import resolve
from khep_twin.files.text import escape_surrogates


def distinct_names(paths: Sequence[Path]) -> list[str]:
    """Return the file names without suffix; equal names with their folders, or with numbers."""
    stems = [escape_surrogates(path.stem) for path in paths]
    names = [
        stem if stems.count(stem) == 1 else f"{escape_surrogates(resolve(path).parent.name)}/{stem}"
        for path, stem in zip(paths, stems, strict=True)
    ]
    counts: Counter[str] = Counter()
    distinct: list[str] = []
    for name in names:
        counts[name] += 1
        distinct.append(name if names.count(name) == 1 else f"{name} {counts[name]}")
    return distinct
