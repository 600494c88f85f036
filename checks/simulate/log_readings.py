"""Readings of a finished log in every way that the product has; they must agree."""

from pathlib import Path

from checks.simulate.simulation import Simulation
from khep_twin.log.attached import calibration_of, compile_shapes, playpen_of
from khep_twin.log.exchanges import Dialogue
from khep_twin.log.reader import (
    hash_file,
    read_arrays,
    read_batches,
    read_first_messages,
    read_log,
    read_series,
)
from khep_twin.log.transcript import unescape


def read_in_every_way(simulation: Simulation, path: Path, has_world: bool) -> None:
    """Read a log as a whole, in pieces, by its heads, and as exchanges; compare the results.

    Args:
        simulation: Simulation.
        path: Path of the log.
        has_world: True for a twin's log, which has samples and a scene.
    """
    log, heads = read_series(path), read_first_messages(path)
    label = log.label
    pieces = list(read_batches(path, lambda _: None))
    arrays = read_arrays(path)[1]
    for topic, series in log.series.items():
        in_pieces = sum(len(piece.series[topic].times_ns) for piece in pieces if topic in piece.series)
        if in_pieces != len(series.times_ns) or topic not in heads.series:
            simulation.violate("recovery", f"{path.name}: {topic} differs by the way of its reading")
        if topic in arrays and (arrays[topic][0] != series.times_ns).any():
            simulation.violate("recovery", f"{path.name}: {topic} has other times as arrays")
    for topic, lines in log.lines.items():
        if [line for piece in pieces for line in piece.lines.get(topic, [])] != lines:
            simulation.violate("recovery", f"{path.name}: {topic} has other lines in pieces")
        if topic.endswith("/serial"):
            dialogue, n_exchanges = Dialogue(), 0
            for line in lines:
                n_exchanges += len(
                    dialogue.feed(line.time_ns, line.name == "host", unescape(line.text) + b"\n")
                )
            simulation.count("exchanges", n_exchanges + len(dialogue.close()))
    hash_file(path)
    if has_world:
        read_log(path)
        playpen_of(label.attachments, path)
        compile_shapes(label.attachments, label.robots, path)
        for robot in label.robots:
            calibration_of(label.attachments, robot, path)
