"""Comparisons of behaviour, from `studies.behaviour`."""

from functools import cache, partial
from pathlib import Path

from studies import behaviour
from studies.behaviour import Row
from studies.behaviour_trials import trials
from studies.fidelity_comparison import Comparison, Outcome, short

_SOURCE = "tables of the sampled Khepera"

_MEASURES = {
    "wall": ("stopping distance [mm]", "turn [deg]", "following distance [mm]", "path [mm]"),
    "cylinder": ("stopping distance [mm]", "turn [deg]", "following distance [mm]", "path [mm]"),
    "lamp": ("stopping distance [mm]", "turn [deg]", "arrival [s]", "path [mm]"),
}
_NETWORKS = " of random networks"


@cache
def rows(folder: Path) -> dict[str, Row]:
    """Return the rows over all controllers, by the name of their comparison."""
    tables, kinematics = behaviour.tables(folder), behaviour.motor_table(folder)
    pooled_rows = behaviour.pooled(behaviour.judge(tables, kinematics, trials()))
    return {_name(row.target, row.measure, "network" in row.controller): row for row in pooled_rows}


def compare(name: str, folder: Path) -> Outcome:
    """Return one comparison, without noise; its floor is that of readings with noise."""
    row = rows(folder)[name]
    peers = {peer: deviation for peer, (deviation, _) in row.peers.items()}
    worst, noisy, motion = map(short, (abs(row.quiet[1]), row.noisy[0], row.motion[0]))
    note = f"worst {worst}; {noisy} with noise; {motion} with the tables' readings; {row.count} runs"
    return Outcome(row.quiet[0], row.floor[0], peers, note)


def _name(target: str, measure: str, of_networks: bool) -> str:
    return f"{target}: {measure.partition(' [')[0]}{_NETWORKS if of_networks else ''}"


COMPARISONS = tuple(
    Comparison(
        name := _name(target, measure, of_networks),
        _SOURCE,
        "sensors fitted to the tables, motion predicted",
        measure.partition("[")[2].rstrip("]"),
        partial(compare, name),
    )
    for target, measures in _MEASURES.items()
    for measure in measures
    for of_networks in ((False, True) if measure.startswith("path") else (False,))
)
"""Comparisons of behaviour, in the page's order."""
