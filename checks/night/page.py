"""Page of the long checks, in Markdown: a row for each part, and the findings."""

from collections.abc import Sequence
from typing import Any

Rows = Sequence[dict[str, Any]]


def number(value: float) -> str:
    """Return a count with separators, and at most two decimals."""
    return (
        f"{value:,.0f}" if value == int(value) or value >= 1000 else f"{value:,.2f}".rstrip("0").rstrip(".")
    )


def format_duration(seconds: float) -> str:
    """Return a time in hours, minutes or seconds."""
    if seconds >= 3600:
        return f"{seconds / 3600:.1f} h"
    return f"{seconds / 60:.0f} min" if seconds >= 120 else f"{seconds:.0f} s"


def state(row: dict[str, Any]) -> str:
    """Return a part's state in a few words."""
    if row["findings"]:
        return f"{len(row['findings'])} finding" + "s" * (len(row["findings"]) > 1)
    if row["done"] >= row["part"].total:
        return "nothing found"
    return "nothing found so far" if row["done"] else "not run"


def markdown(rows: Rows, now: str) -> str:
    """Return the page as Markdown."""
    lines = ["# Night of khep_twin", "", f"State of {now}. {summary(rows)}", ""]
    lines += ["| part | done | of | time | findings | date | commit |", "|---|--:|--:|--:|---|---|---|"]
    for row in rows:
        part = row["part"]
        cells = [
            f"**{part.name}**: {part.description}",
            number(row["done"]),
            f"{number(part.total)} {part.unit}",
            format_duration(row["seconds"]) if row["seconds"] else "",
            state(row),
            row["date"],
            ", ".join(row["commits"]),
        ]
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    lines += ["", "The last command of each part, and its output:", ""]
    for row in rows:
        if row["command"]:
            lines.append(f"- {row['part'].name}: `{row['command']}`")
            lines += [f"  - {figure}" for figure in row["figures"]]
    for row in rows:
        for run in row["findings"]:
            lines += ["", f"## Finding of {row['part'].name}", "", f"`{run.command}`", "", "```text"]
            lines += [run.finding.replace("```", "'''"), "```"]
    return "\n".join(lines) + "\n"


def summary(rows: Rows) -> str:
    """Return the state of all parts in a sentence."""
    n_complete = sum(row["done"] >= row["part"].total for row in rows)
    findings = sum(len(row["findings"]) for row in rows)
    return f"{n_complete} of {len(rows)} parts are whole; {findings or 'no'} finding{'s' * (findings != 1)}."
