"""Record of results, to check that a change of names, files or sentences does not change behaviour.

    python -m tools record              compare with tools/record.json: prints "same", or each difference
    python -m tools record --write      rewrite tools/record.json

It has, for each shipped playpen and two seeds: a run of the Braitenberg vehicle and one of random commands,
with replies, hashes of the state and the samples of each channel of the log; rollouts in MuJoCo and in the
plane; the scene as MJCF. Names of channels and of files are left out. The record is valid for the versions
and the machine that it names.
"""

import hashlib
import json
import os
import platform
import subprocess
import sys
import tempfile
from collections import defaultdict
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import version
from pathlib import Path

import numpy as np
from mcap.reader import make_reader

from khep_twin.episodes.batch import rollout
from khep_twin.episodes.controllers import Braitenberg, Network
from khep_twin.episodes.episode_setup import EpisodeSetup
from khep_twin.errors import KhepTwinError
from khep_twin.playpen import Playpen
from khep_twin.playpen_to_mjcf import to_mjcf
from khep_twin.robots.model import Feature
from tools.command_table import command_line

RECORD = Path(__file__).with_suffix(".json")
SEEDS = (1, 2)
SECONDS = "10"
PACKAGES = ("mujoco", "numpy", "numba")

DRIVER = """
import random

rng = random.Random({seed})


def drive(robot):
    for _ in range(4):
        robot.ask(rng.choice("N O E H K I,3 B R,3 T,1,F".split()))
    speeds = (rng.randrange(-20, 21), rng.randrange(-20, 21))
    robot.ask(rng.choice(["D,%d,%d", "D,%d,%d", "C,%d,%d", "G,%d,%d"]) % speeds)
    robot.ask("L,%d,2" % rng.randrange(2))
    robot.sleep(rng.uniform(0, 0.2))
"""


def names() -> list[str]:
    """Return the shipped playpens with Kheperas alone."""
    playpens = sorted(path.stem for path in Path("khep_twin/assets/playpens").glob("*.toml"))
    return [
        name
        for name in playpens
        if all(Feature.LINE in robot.robot_model.features for robot in Playpen.load(name).robots)
    ]


def digest(*parts: bytes) -> str:
    """Return a short hash of bytes, including their boundaries."""
    sha = hashlib.sha256()
    for part in parts:
        sha.update(len(part).to_bytes(8, "little") + part)
    return sha.hexdigest()[:16]


def run(name: str, seed: int, controller: str, folder: Path) -> list[str]:
    """Run a controller; return the sorted hashes of its log's channels, without their names."""
    program = folder / f"driver{seed}.py"
    program.write_text(DRIVER.format(seed=seed))
    log = folder / f"{name}-{seed}-{controller}.mcap"
    argument = f"{program}:drive" if controller == "driver" else controller
    words = ["run", argument, "--playpen", name, "--seed", str(seed), "--seconds", SECONDS, "--log", str(log)]
    subprocess.run([sys.executable, "-m", "khep_twin", *words], check=True, stdout=subprocess.DEVNULL)
    with log.open("rb") as file:
        contents: dict[str, list[bytes]] = defaultdict(list)
        for schema, channel, message in make_reader(file).iter_messages():
            # Names and sentences may change.
            if channel.topic in ("/channel_names", "/robot_description", "/events", "/scene", "/snapshot"):
                continue
            kind = schema.name if schema else ""
            contents[channel.topic] += [kind.encode(), message.log_time.to_bytes(8, "little"), message.data]
    log.unlink()
    return sorted(digest(*parts) for parts in contents.values())


def run_rollouts(name: str, planar: bool) -> list[str]:
    """Return the hashes of the rollouts' results; none if the playpen does not allow rollouts."""
    scene = Playpen.load(name)
    network = Network(hidden=(6,), recurrent=True, ambient=True)
    genes = np.random.default_rng(1).normal(size=(8, network.n_genes))
    hashes: list[str] = []
    for controller, controller_genes in ((Braitenberg(), None), (network, genes)):
        try:
            setup = EpisodeSetup(scene, planar=planar)
            results = rollout(setup, controller, range(8), float(SECONDS), genes=controller_genes)
        except (KhepTwinError, ValueError):
            return []
        values = [np.asarray(results.metrics[key]).tobytes() for key in results.metrics]
        hashes.append(digest(results.registers.tobytes(), results.poses.tobytes(), *values))
    return hashes


def record() -> Iterator[tuple[str, list[str]]]:
    """Yield the name and hashes of each result."""
    for name in names():
        yield f"{name}: MJCF", [digest(to_mjcf(Playpen.load(name)).encode())]
        for planar in (False, True):
            yield f"{name}: rollout{' in the plane' if planar else ''}", run_rollouts(name, planar)
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(os.cpu_count()) as pool:
        tasks = [(name, seed, who) for name in names() for seed in SEEDS for who in ("braitenberg", "driver")]
        for task, hashes in zip(tasks, pool.map(lambda task: run(*task, Path(folder)), tasks), strict=True):
            yield "{}: seed {}, {}".format(*task), hashes


def main() -> int:
    """Compare with the record, or write it; return 1 if a result differs."""
    parser = command_line(__doc__)
    parser.add_argument("--write", action="store_true", help="rewrite the record")
    write = parser.parse_args().write
    made_with = {"machine": platform.machine(), **{name: version(name) for name in PACKAGES}}
    current = {"made with": made_with, "results": dict(record())}
    if write:
        RECORD.write_text(json.dumps(current, indent=1) + "\n")
        print(f"{RECORD.name}: {len(current['results'])} results")
        return 0
    saved = json.loads(RECORD.read_text())
    if saved["made with"] != made_with:
        print(f"the record was made with {saved['made with']}; expected {made_with}")
        return 1
    kinds = saved["results"].keys() | current["results"].keys()
    differing = [kind for kind in sorted(kinds) if saved["results"].get(kind) != current["results"].get(kind)]
    print("\n".join(f"differs: {kind}" for kind in differing) or "same")
    return 1 if differing else 0


if __name__ == "__main__":
    sys.exit(main())
