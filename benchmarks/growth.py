"""Growth of time per simulated second with blocks, robots and episodes in a batch.

`python -m benchmarks.growth` prints these tables alone. Blocks stand in the same large arena, in an order
from the robot outwards, so with more of them the robot meets the same ones first.
"""

import sys
from collections.abc import Iterator, Sequence

import numpy as np

from benchmarks.scale import bare_row, batch_row, episode_row, world_row
from benchmarks.table import COST, LEGEND, Row, Table, measure, text
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.playpen import Arena, Block, Playpen, RobotEntry

BLOCKS = (0, 20, 100, 1000)
ROBOTS = (1, 2, 8, 20)
BATCHES = (32, 128, 1024)

TWENTY_BLOCKS = "twenty blocks"

CELL_MM = 150.0
"""Side of the square for each block [mm]: a block of 60 x 25 mm leaves a robot room on all sides."""


def field(n_blocks: int, n_robots: int = 1, cells: int = 32) -> Playpen:
    """Return blocks at random angles around robots in rows, in a square arena of `cells` a side.

    Raises:
        ValueError: There are fewer cells.
    """
    middle = (cells - 1) / 2
    grid = sorted(
        ((row, column) for row in range(cells) for column in range(cells)),
        key=lambda cell: (max(abs(coordinate - middle) for coordinate in cell), cell),
    )
    if n_blocks + n_robots > len(grid):
        raise ValueError(f"{n_blocks} blocks and {n_robots} robots; expected {len(grid)} in all")
    rng = np.random.default_rng(1)
    angles = rng.uniform(0, 180, len(grid)).round(1).tolist()
    shifts = rng.uniform(-20, 20, (len(grid), 2)).round(1).tolist()
    positions = [((column + 0.5) * CELL_MM, (row + 0.5) * CELL_MM) for row, column in grid]
    blocks = tuple(
        Block(x_mm=x + dx, y_mm=y + dy, length_mm=60, width_mm=25, height_mm=50, angle_deg=angle)
        for (x, y), (dx, dy), angle in zip(
            positions[n_robots : n_robots + n_blocks], shifts[n_robots:], angles[n_robots:], strict=False
        )
    )
    robots = tuple(RobotEntry(x_mm=x, y_mm=y, heading_deg=30) for x, y in positions[:n_robots])
    arena = Arena(width_mm=cells * CELL_MM, height_mm=cells * CELL_MM)
    return Playpen.model_validate(
        {"version": 1, "name": "field", "arena": arena, "block": blocks, "robot": robots}
    )


def twenty_blocks() -> Playpen:
    """Return twenty blocks in 900 x 900 mm, so that one is always near the robot."""
    return field(20, cells=6)


def blocks_tables(seconds: float, rounds: int, numbers: Sequence[int] = BLOCKS) -> Iterator[Table]:
    """Measure an episode and the bare loop among increasing numbers of blocks."""
    setups = [(f"{number} blocks", EpisodeSetup(field(number))) for number in numbers]
    lives: list[Row] = [episode_row(name, setup, seconds) for name, setup in setups]
    bare: list[Row] = [bare_row(name, setup, seconds) for name, setup in setups]
    yield measure("blocks, compiled life", lives, rounds, unit=COST, cost=True)
    yield measure("blocks, bare mj_step with rangefinders", bare, rounds, unit=COST, cost=True)


def robots_table(seconds: float, rounds: int, numbers: Sequence[int] = ROBOTS) -> Table:
    """Measure a world without a line, with increasing numbers of robots."""
    rows = [
        world_row(f"{number} robot{'s' * (number > 1)}", field(20, number), seconds) for number in numbers
    ]
    return measure("robots, World among 20 blocks", rows, rounds, unit=COST, cost=True)


def batches_table(episode_s: float, rounds: int, numbers: Sequence[int] = BATCHES) -> Table:
    """Measure batches of increasing numbers of short episodes, on two threads."""
    setup = EpisodeSetup(Playpen.load("default"))
    rows = [batch_row(f"{number} lives", setup, number, episode_s, 2) for number in numbers]
    title = f"lives of {episode_s:g} s in a batch, default, 2 threads"
    return measure(title, rows, rounds, unit=COST, cost=True)


def tables(part: float, rounds: int, n_sizes: int | None = None) -> Iterator[Table]:
    """Yield all tables of growth.

    Args:
        part: Fraction of the usual length.
        rounds: Rounds of each table.
        n_sizes: Number of sizes measured in each table; None for all.
    """
    seconds = max(round(10 * part), 1)
    yield from blocks_tables(seconds, rounds, BLOCKS[:n_sizes])
    yield robots_table(seconds, rounds, ROBOTS[:n_sizes])
    yield batches_table(max(round(part, 1), 0.2), rounds, BATCHES[:n_sizes])


def main() -> None:
    for table in tables(1.0, 3):
        print(text([table]), end="\n\n", flush=True)
    print(LEGEND)


if __name__ == "__main__":
    sys.exit(main())
