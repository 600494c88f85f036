"""Study of the values that a shadow learns: `python -m studies shadow-fits [FOLDER]`.

Stand-in robots of the same model drive for five minutes, and a shadow follows the recordings. The study
prints the share of true values inside the 95 % intervals that `khep-twin fit --from` reports, and the errors
in standard deviations of these. The robots are sound, and the shadow does not diagnose faults.
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
from studies.fit_intervals import value_in
from tools.command_table import command_line


def main() -> None:
    parser = command_line(__doc__)
    parser.add_argument("folder", type=Path, nargs="?", help="folder of the recordings, kept")
    parser.add_argument("--robots", type=int, default=10, help="number of robots")
    parser.add_argument("--playpen", default="obstacles", help="name or path of the playpen")
    parser.add_argument("--seconds", type=float, default=300.0, help="length of each recording [s]")
    parser.add_argument("--particles", type=int, default=1000, help="particles of the shadow")
    parser.add_argument("--asks-counters", action="store_true", help="ask H as well")
    options = parser.parse_args()
    Diagnosis._diagnose = lambda self, time_ns: None  # pyright: ignore[reportPrivateUsage]
    playpen = Playpen.load(options.playpen)
    start = calibration.read(playpen.robots[0].calibration)[0]
    errors: defaultdict[str, list[tuple[float, float, float]]] = defaultdict(list)
    with TemporaryDirectory() as temporary:
        folder = options.folder or Path(temporary)
        folder.mkdir(parents=True, exist_ok=True)
        for seed in range(options.robots):
            name = f"{playpen.name}_{options.seconds:g}_{'NH' if options.asks_counters else 'N'}_{seed}"
            path = folder / f"{name}.mcap"
            if not path.exists():
                host = ("avoider", "wall follower", "wanderer")[seed % 3]
                record(
                    path,
                    playpen,
                    seed=seed,
                    seconds=options.seconds,
                    host=host,
                    asks_counters=options.asks_counters,
                )
            robot_calibration = calibration.vary(start, stream(seed, "robot", 0, "spread"))
            shadow = Shadow(playpen, ShadowSettings(particles=options.particles))
            follower = Follower(shadow)
            for chunk in read_recording(path).chunks:
                for _ in follower.feed(chunk):
                    pass
            for value, _ in learned_values(shadow.learned, start):
                _, key, *sensor = value.path
                part = (
                    value_in(robot_calibration, value) / value_in(start, value),
                    value.value / value_in(start, value),
                )
                deviation = value.interval / value_in(start, value) / CONFIDENCE
                errors[key].append((part[0], part[1], deviation))
                print(
                    f"{seed} {key}{sensor or ''}: {part[0]:.4f}, found {part[1]:.4f} +- {deviation:.4f}",
                    flush=True,
                )
    for key, rows in errors.items():
        actual, value, deviation = np.array(rows).T
        off = (value - actual) / deviation
        print(
            f"{key:16} {np.mean(np.abs(off) < CONFIDENCE):4.0%} of {len(rows)} inside of 95 %, errors "
            f"{np.sqrt(np.mean(off**2)):.2f} of the fitted deviation {np.median(deviation):.4f}; "
            f"rms {np.sqrt(np.mean((value - actual) ** 2)):.4f}, of robots {np.std(actual):.4f}"
        )
