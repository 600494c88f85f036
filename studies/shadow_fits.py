"""Study of what a shadow learns: `python -m studies shadow-fits [FOLDER]`.

Stand-in robots of the same make drive for five minutes, and a shadow follows the recordings. Printed is how
often the robot's own values lie in the 95 % intervals that `khep-twin fit --from` tells, and the errors in
standard deviations of these. The robots are sound, and faults are not looked for.
"""

from collections import defaultdict
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from khep_twin.lab.fit.least_squares import CONFIDENCE
from khep_twin.lab.fit.shadow_fit import learned_values
from khep_twin.playpen import Playpen
from khep_twin.randomness import stream
from khep_twin.sensing import calibration
from khep_twin.shadow.diagnosis import Diagnosis
from khep_twin.shadow.following import Follower
from khep_twin.shadow.recording import read_recording
from khep_twin.shadow.shadow import Shadow, ShadowSettings
from stand_ins.recordings import record
from tools.command_table import command_line


def main() -> None:
    options = command_line(__doc__)
    options.add_argument("folder", type=Path, nargs="?", help="folder of the recordings, kept")
    options.add_argument("--robots", type=int, default=10, help="number of robots")
    options.add_argument("--playpen", default="obstacles", help="name or path of the playpen")
    options.add_argument("--seconds", type=float, default=300.0, help="length of each recording [s]")
    options.add_argument("--particles", type=int, default=1000, help="particles of the shadow")
    options.add_argument("--asks-counters", action="store_true", help="ask H as well")
    given = options.parse_args()
    Diagnosis._diagnose = lambda self, time_ns: None  # pyright: ignore[reportPrivateUsage]
    playpen = Playpen.load(given.playpen)
    start = calibration.read(playpen.robots[0].calibration)[0]
    errors: defaultdict[str, list[tuple[float, float, float]]] = defaultdict(list)
    with TemporaryDirectory() as temporary:
        folder = given.folder or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        for seed in range(given.robots):
            name = f"{playpen.name}_{given.seconds:g}_{'NH' if given.asks_counters else 'N'}_{seed}"
            path = folder / f"{name}.mcap"
            if not path.exists():
                host = ("avoider", "wall follower", "wanderer")[seed % 3]
                record(
                    path,
                    playpen,
                    seed=seed,
                    seconds=given.seconds,
                    host=host,
                    asks_counters=given.asks_counters,
                )
            own = calibration.vary(start, stream(seed, "robot", 0, "spread"))
            shadow = Shadow(playpen, ShadowSettings(particles=given.particles))
            follower = Follower(shadow)
            for heard in read_recording(path).chunks:
                for _ in follower.feed(heard):
                    pass
            for value, _ in learned_values(shadow.learned, start):
                _, key, *sensor = value.path
                part = value.value_in(own) / value.value_in(start), value.value / value.value_in(start)
                told = value.interval / value.value_in(start) / CONFIDENCE
                errors[key].append((part[0], part[1], told))
                print(
                    f"{seed} {key}{sensor or ''}: {part[0]:.4f}, found {part[1]:.4f} +- {told:.4f}",
                    flush=True,
                )
    for key, rows in errors.items():
        own, value, told = np.array(rows).T
        off = (value - own) / told
        print(
            f"{key:16} {np.mean(np.abs(off) < CONFIDENCE):4.0%} of {len(rows)} inside of 95 %, errors "
            f"{np.sqrt(np.mean(off**2)):.2f} of the told deviation {np.median(told):.4f}; "
            f"rms {np.sqrt(np.mean((value - own) ** 2)):.4f}, of robots {np.std(own):.4f}"
        )
