"""docs/fidelity.md, every comparison of the twin with reality, and its picture.

The measured tables are located as in `studies.infrared_fits`. A comparison belongs to a section of
`SECTIONS`; the page follows that list, and a test checks that it does.
"""

from collections.abc import Mapping
from pathlib import Path

from matplotlib.figure import Figure

from studies import (
    fidelity_behaviour,
    fidelity_light,
    fidelity_manual,
    fidelity_motion,
    fidelity_noise,
    fidelity_proximity,
)
from studies.fidelity_comparison import Comparison, Outcome, short
from studies.infrared_fits import reference
from tools.command_table import command_line

PAGE = Path(__file__).parents[1] / "docs" / "fidelity.md"
PICTURE = PAGE.parent / "pictures" / "fidelity.png"

SECTIONS: dict[str, tuple[Comparison, ...]] = {
    "Proximity": (*fidelity_proximity.COMPARISONS, *fidelity_manual.COMPARISONS),
    "Ambient light": fidelity_light.COMPARISONS,
    "Noise": fidelity_noise.COMPARISONS,
    "Odometry": fidelity_motion.COMPARISONS,
    "Supply": fidelity_motion.SUPPLY,
    "Behaviour": fidelity_behaviour.COMPARISONS,
}
"""Comparisons by section. A new one is a line here: a heading and its comparisons."""

_INTRODUCTIONS = {
    "Proximity": """
        Root-mean-square errors without noise, in counts of 1023 or in mm. The twin's counts are read in
        MuJoCo, with a robot at the real robot's positions.""",
    "Ambient light": """
        Root-mean-square errors without noise. The sampled lamp is on the scale of its table, 1023 · (500 -
        counts) / 500.""",
    "Noise": """
        The twin is turned in a room with a lamp that flickers, as the robot was (`python -m
        studies noise-fits`). Differences along the bearings separate the noise from the curve.""",
    "Odometry": """
        Deviations of the motion at constant speeds, and of the share of robots that return home by odometry.
        100 robots of the same make drive for 30 s (`python -m studies home-test`).""",
    "Supply": "Root-mean-square error of cell voltage, and deviation of mean current, against measurements.",
    "Behaviour": """
        The same controllers run from the same poses in the twin and in a world whose sensors are read from
        the tables (`python -m studies behaviour`). The figures are root-mean-square deviations without
        noise. The floor is the deviation between two runs in the world of tables with different noise.
        Robots in that world move by evorobot's motor table, without inertia. The deviation of a twin with
        the tables' readings is therefore due to motion alone. Paths are compared until a robot is nearer
        than any sample, 5 mm. Random networks that circle and waver amplify small differences. "Nearest
        sample" is the world of tables as evorobot's simulator reads it.""",
}

_HEAD = (
    """
    This page compares the twin with measurements of real robots. Each row has its source, and the part of
    the twin that was fitted to it, or "predicted". The floor is the deviation that the robot's noise would
    leave to a perfect twin. Other simulators' deviations follow from their published responses. Smaller is
    better.""",
    "![Deviations of the twin and of other simulators, on a logarithmic scale](pictures/fidelity.png)",
    """
    `python -m studies fidelity` generates this page from the measured tables in the folder that
    `KHEP_TWIN_REFERENCE_DATA` names. [senses.md](senses.md) describes the models of the sensors.""",
)


def text(outcomes: Mapping[str, Outcome]) -> str:
    """Return the page, from the outcomes by comparison."""
    parts = ["# Fidelity\n", *(f"{_wrapped(paragraph)}\n" for paragraph in _HEAD)]
    for section, comparisons in SECTIONS.items():
        lines = [
            f"## {section}\n",
            f"{_wrapped(_INTRODUCTIONS.get(section, ''))}\n",
            "| comparison | source | fitted or predicted | twin | floor | other simulators | notes |",
            "|---|---|---|---|---|---|---|",
            *(_line(comparison, outcomes[comparison.name]) for comparison in comparisons),
            "",
        ]
        parts.append("\n".join(lines))
    return "\n".join(parts)


def names(page: str) -> dict[str, list[str]]:
    """Return the names of a page's comparisons by section."""
    names_by_section: dict[str, list[str]] = {}
    section = ""
    for line in page.splitlines():
        if line.startswith("## "):
            section = line[3:]
        elif line.startswith("| ") and not line.startswith("| comparison |"):
            names_by_section.setdefault(section, []).append(line.split(" | ")[0][2:])
    return names_by_section


def draw(outcomes: Mapping[str, Outcome], target: Path) -> None:
    """Draw a bar for each comparison of the twin, with the floor and other simulators."""
    rows = [
        (section, comparison, outcomes[comparison.name])
        for section, comparisons in SECTIONS.items()
        for comparison in comparisons
    ]
    figure = Figure(figsize=(10, 0.27 * len(rows) + 1.2), layout="constrained")
    axes = figure.subplots()
    for predicted, colour in ((True, _INK), (False, _PALE)):
        bars = [
            (row, outcome.figure)
            for row, (_, comparison, outcome) in enumerate(rows)
            if comparison.is_predicted == predicted
        ]
        label = "twin, predicted" if predicted else "twin, fitted"
        axes.barh(*zip(*bars, strict=True), color=colour, height=0.66, label=label)
    floors = [(outcome.floor, row) for row, (_, _, outcome) in enumerate(rows) if outcome.floor is not None]
    axes.plot(*zip(*floors, strict=True), "|", color=_RED, ms=13, mew=2.5, label="noise floor")
    peers = dict.fromkeys(peer for _, _, outcome in rows for peer in outcome.peers)
    for number, (peer, (marker, colour)) in enumerate(zip(peers, _MARKS, strict=False)):
        points = [
            (outcome.peers[peer], row) for row, (_, _, outcome) in enumerate(rows) if peer in outcome.peers
        ]
        offset_rows = [row + 0.13 * (number - 1.5) for _, row in points]
        deviations = [deviation for deviation, _ in points]
        axes.plot(deviations, offset_rows, marker, color=colour, mec="white", mew=0.6, ms=6, label=peer)
    axes.set_xscale("log")
    axes.set_xlim(right=5 * axes.get_xlim()[1])  # room for the sections' names
    axes.set_yticks(
        range(len(rows)), [f"{comparison.name} [{comparison.unit}]" for _, comparison, _ in rows], fontsize=8
    )
    axes.set_ylim(len(rows) - 0.4, -0.6)
    for row, (section, _, _) in enumerate(rows):
        if row == 0 or section != rows[row - 1][0]:
            axes.axhline(row - 0.5, color="#bbbbbb", lw=0.8)
            position = {"transform": axes.get_yaxis_transform(), "ha": "right", "va": "top"}
            axes.text(1, row - 0.45, section, fontsize=9, weight="bold", **position)
    axes.grid(axis="x", color="#e5e5e5", lw=0.7)
    axes.set_axisbelow(True)
    axes.set_xlabel("deviation from the robot, in the unit of each row; smaller is better")
    axes.spines[["top", "right"]].set_visible(False)
    figure.legend(loc="outside lower center", ncols=4, frameon=False, fontsize=8.5)
    figure.savefig(target, dpi=110, metadata={"Software": None})


_INK, _PALE, _RED = "#1b4965", "#9dbfd1", "#e4572e"
_MARKS = (("s", "#9a9a9a"), ("o", "#5b8c5a"), ("^", "#c08a2b"), ("D", "#8a6fb0"))


def _line(comparison: Comparison, outcome: Outcome) -> str:
    peers = ", ".join(f"{name} {short(value)}" for name, value in outcome.peers.items())
    floor = "" if outcome.floor is None else short(outcome.floor)
    twin = f"{short(outcome.figure)} {comparison.unit}"
    cells = comparison.name, comparison.source, comparison.basis, twin, floor, peers, outcome.note
    return f"| {' | '.join(cells)} |"


def _wrapped(paragraph: str, width: int = 125) -> str:
    lines = [""]
    for word in paragraph.split():
        if len(lines[-1]) + len(word) >= width:
            lines.append("")
        lines[-1] += f"{' ' if lines[-1] else ''}{word}"
    return "\n".join(lines)


def main() -> None:
    """Make all comparisons; write the page and its picture."""
    command_line(__doc__).parse_args()
    folder = reference()
    outcomes: dict[str, Outcome] = {}
    for comparisons in SECTIONS.values():
        for comparison in comparisons:
            outcomes[comparison.name] = comparison.measure(folder)
            print(
                f"{comparison.name}: {short(outcomes[comparison.name].figure)} {comparison.unit}", flush=True
            )
    PAGE.write_text(text(outcomes), encoding="utf-8")
    draw(outcomes, PICTURE)
