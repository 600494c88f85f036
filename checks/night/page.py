"""Page of the long checks: a row for each part, as Markdown and as HTML."""

from collections.abc import Sequence
from html import escape
from typing import Any

STYLE = """
:root { color-scheme: light dark; --ink: #1d2430; --dim: #667085; --line: #e3e7ee; --paper: #fbfcfe;
  --card: #fff; --good: #1a8a5a; --bad: #c0362c; --wait: #b7bfcc; }
@media (prefers-color-scheme: dark) { :root { --ink: #e7eaf0; --dim: #98a2b3; --line: #2b3341;
  --paper: #12161d; --card: #191f29; --good: #4cc38a; --bad: #ff7a6e; --wait: #4a5568; } }
body { margin: 0; background: var(--paper); color: var(--ink); font: 15px/1.5 system-ui, sans-serif; }
main { max-width: 1180px; margin: 0 auto; padding: 40px 28px 64px; }
h1 { font-size: 26px; margin: 0 0 4px; letter-spacing: -.01em; }
header p { margin: 0 0 24px; color: var(--dim); }
.sum { display: flex; gap: 12px; margin: 0 0 24px; flex-wrap: wrap; }
.sum div { background: var(--card); border: 1px solid var(--line); border-radius: 10px;
  padding: 12px 18px; min-width: 130px; }
.sum b { display: block; font-size: 22px; font-variant-numeric: tabular-nums; }
.sum span { color: var(--dim); font-size: 13px; }
table { width: 100%; border-collapse: collapse; background: var(--card); border: 1px solid var(--line);
  border-radius: 10px; overflow: hidden; }
th { text-align: left; font-size: 12px; font-weight: 600; color: var(--dim); padding: 10px 14px;
  border-bottom: 1px solid var(--line); }
td { padding: 12px 14px; border-bottom: 1px solid var(--line); vertical-align: top; }
tr:last-child td { border-bottom: 0; }
td.n, th.n { text-align: right; font-variant-numeric: tabular-nums; white-space: nowrap; }
.name { font-weight: 600; }
.what { color: var(--dim); font-size: 13px; }
.bar { height: 5px; border-radius: 3px; background: var(--line); margin-top: 6px; overflow: hidden;
  min-width: 130px; }
.bar i { display: block; height: 100%; background: var(--good); border-radius: 3px; }
.bad .bar i { background: var(--bad); }
.state { white-space: nowrap; font-weight: 600; }
.state.good { color: var(--good); } .state.bad { color: var(--bad); }
.state.some { color: var(--ink); } .state.none { color: var(--dim); font-weight: 400; }
code { font: 12px/1.5 ui-monospace, monospace; color: var(--dim); overflow-wrap: anywhere; }
pre { font: 12px/1.5 ui-monospace, monospace; background: var(--card); border: 1px solid var(--line);
  border-left: 3px solid var(--bad); border-radius: 6px; padding: 12px 16px; overflow-x: auto; }
h2 { font-size: 18px; margin: 36px 0 8px; }
.when { color: var(--dim); font-size: 13px; white-space: nowrap; }
"""

Rows = Sequence[dict[str, Any]]


def number(value: float) -> str:
    """Return a count with separators, and at most two decimals."""
    return (
        f"{value:,.0f}" if value == int(value) or value >= 1000 else f"{value:,.2f}".rstrip("0").rstrip(".")
    )


def took(seconds: float) -> str:
    """Return a time in hours, minutes or seconds."""
    if seconds >= 3600:
        return f"{seconds / 3600:.1f} h"
    return f"{seconds / 60:.0f} min" if seconds >= 120 else f"{seconds:.0f} s"


def state(row: dict[str, Any]) -> tuple[str, str]:
    """Return a part's state: its kind, and a word."""
    if row["findings"]:
        return "bad", f"{len(row['findings'])} finding" + "s" * (len(row["findings"]) > 1)
    if row["done"] >= row["part"].wanted:
        return "good", "nothing found"
    return ("some", "nothing found so far") if row["done"] else ("none", "not run")


def markdown(rows: Rows, now: str) -> str:
    """Return the page as Markdown."""
    lines = ["# Night of khep_twin", "", f"State of {now}. {summary(rows)}", ""]
    lines += ["| part | done | of | time | findings | date | commit |", "|---|--:|--:|--:|---|---|---|"]
    for row in rows:
        part = row["part"]
        cells = [
            f"**{part.name}**: {part.what}",
            number(row["done"]),
            f"{number(part.wanted)} {part.unit}",
            took(row["seconds"]) if row["seconds"] else "",
            state(row)[1],
            row["date"],
            ", ".join(row["commits"]),
        ]
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    lines += ["", "The last command of each part, and what it told:", ""]
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
    whole = sum(row["done"] >= row["part"].wanted for row in rows)
    findings = sum(len(row["findings"]) for row in rows)
    return f"{whole} of {len(rows)} parts are whole; {findings or 'no'} finding{'s' * (findings != 1)}."


def html(rows: Rows, now: str) -> str:
    """Return the page as HTML, of one file."""
    findings = sum(len(row["findings"]) for row in rows)
    cards = [
        (f"{sum(row['done'] >= row['part'].wanted for row in rows)} of {len(rows)}", "parts whole"),
        (f"{sum(bool(row['done']) for row in rows)}", "parts begun"),
        (f"{findings or 'no'}", "finding" + "s" * (findings != 1)),
        (took(sum(row["seconds"] for row in rows)), "time of all processes"),
    ]
    body = "".join(_row(row) for row in rows)
    details = "".join(
        f"<h2>Finding of {escape(row['part'].name)}</h2><p><code>{escape(run.command)}</code></p>"
        f"<pre>{escape(run.finding)}</pre>"
        for row in rows
        for run in row["findings"]
    )
    heads = "<th>part</th><th class=n>done</th><th class=n>of</th><th class=n>time</th><th>findings</th>"
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8"><title>Night of khep_twin</title>'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<style>{STYLE}</style></head><body><main><header><h1>Night of khep_twin</h1>"
        f"<p>Long checks, by their own output. State of {escape(now)}.</p></header><div class=sum>"
        + "".join(f"<div><b>{escape(value)}</b><span>{name}</span></div>" for value, name in cards)
        + f"</div><table><thead><tr>{heads}<th>last run</th></tr></thead><tbody>{body}</tbody></table>"
        f"{details}</main></body></html>\n"
    )


def _row(row: dict[str, Any]) -> str:
    part, (kind, word) = row["part"], state(row)
    share = min(row["done"] / part.wanted, 1.0)
    figures = "".join(f"<div class=what>{escape(figure)}</div>" for figure in row["figures"][:4])
    command = f"<code>{escape(row['command'])}</code>" if row["command"] else ""
    return (
        f'<tr class="{kind}"><td><div class=name>{escape(part.name)}</div>'
        f"<div class=what>{escape(part.what)}</div>{command}</td>"
        f"<td class=n>{number(row['done'])}<div class=bar><i style='width:{100 * share:.2f}%'></i></div></td>"
        f"<td class=n>{number(part.wanted)}<div class=what>{escape(part.unit)}</div></td>"
        f"<td class=n>{took(row['seconds']) if row['seconds'] else ''}</td>"
        f'<td><span class="state {kind}">{word}</span>{figures}</td>'
        f"<td class=when>{escape(row['date'])}<br>{escape(', '.join(row['commits']))}</td></tr>"
    )
