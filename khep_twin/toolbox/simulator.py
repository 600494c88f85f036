"""The Khepera Toolbox's simulated commands, on a twin in lock-step.

    btmap1 = open_default(seed=1)       # or open_custom("obstacles"), open_custom("scan.mat")
    sim_sms(2, 1, 1)
    a = sim_rps(2)
    kheprom(btmap1)                     # 50 ms pass

A command takes no simulated time: it reads and writes the board's registers immediately, and its effects
follow while `kheprom` advances time. Between commands, simulated time stands still. Board and physics are
those of every other twin: speeds have magnitudes, wheels differ, counters count pulses.

One playpen is open at a time, as in the toolbox; functions raise a `PlaypenError` without it or with another
`btmap1`. With a single robot `port_id` is ignored; with several it is the robot's number, from 1.
"""

import atexit
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import SupportsFloat

import numpy as np
from numpy.typing import NDArray

from khep_twin.board.kernel import LEFT, RIGHT, Wheel
from khep_twin.clock import NS_PER_S, to_ns
from khep_twin.errors import BitmapError, PlaypenError, PortError
from khep_twin.files.paths import StrPath
from khep_twin.host import Khepera
from khep_twin.interventions.move_robot import scan
from khep_twin.lab.experiment.start_poses import with_lighting
from khep_twin.playpen import Playpen, bitmap, bitmap_files
from khep_twin.ports.protocol_khep import Serial
from khep_twin.ports.twin import Twin, TwinOptions, open_twin
from khep_twin.toolbox import serial_commands
from khep_twin.toolbox.serial_commands import Row

CYCLE = 0.05
"""Default cycle of `kheprom` [s] (assumed: about the time of `rps` and `sms` on a robot)."""

_open_playpen: "OpenPlaypen | None" = None


class OpenPlaypen:
    """Playpen that is open in the simulator, the `btmap1` of a program.

    Its `twin` has the ground truth; its `robots` are hosts whose serial lines take no simulated time.
    """

    def __init__(self, twin: Twin, robots: tuple[Khepera, ...] = ()) -> None:
        self.twin = twin
        views = [Twin(twin.world, (robot,), twin.options) for robot in twin.robots]
        self.robots = robots or tuple(Khepera(Serial.of(view, timeout=1.0)) for view in views)

    @property
    def time(self) -> float:
        """Simulated time since it was opened [s]."""
        return self.twin.world.time_ns / NS_PER_S

    def index(self, port_id: int) -> int:
        """Return the index of a port's robot, from 0."""
        if len(self.robots) == 1:
            return 0
        numbers = range(1, len(self.robots) + 1)
        if port_id not in numbers:
            text = f"port_id = {port_id!r}: no such robot"
            raise PortError(text, key="port_id", value=port_id, expected=numbers)
        return int(port_id) - 1

    def pass_time(self, duration: float) -> None:
        """Advance simulated time [s]."""
        self.twin.advance_to(self.twin.world.time_ns + to_ns(duration))


def open_default(
    *,
    seed: int = 0,
    noise: bool = True,
    rom: str | None = None,
    lighting: str | None = None,
    log: StrPath | None = None,
) -> OpenPlaypen:
    """Open four walls with a robot in the middle, RoboRunner's Open Default; close the previous playpen.

    The arguments are those of `open_custom`; `place_lamp` adds lamps.
    """
    return open_custom("default", seed=seed, noise=noise, rom=rom, lighting=lighting, log=log)


def open_custom(
    playpen: StrPath | Playpen | NDArray[np.generic],
    *,
    seed: int = 0,
    noise: bool = True,
    rom: str | None = None,
    lighting: str | None = None,
    log: StrPath | None = None,
) -> OpenPlaypen:
    """Open a playpen, RoboRunner's Open Custom; close the previous one.

    Args:
        playpen: Name of a shipped one, a playpen file, a scanned MAT file of the toolbox or a PNG, or the
            matrix `btmap1` of a scan (rows, columns), with 44 for solid pixels, its first row at the bottom.
        seed: Seed of every random stream.
        noise: Add noise to the sensors.
        rom: Version of the robots' ROM, if not the playpen's; with "4.06" `sim_rmc` has the toolbox's modes.
        lighting: Lamp Control, "all", "random" or "sequenced", or "off" for no lamps; without, the playpen's.
        log: File to record the run in.

    Raises:
        PlaypenError: It cannot be used.
        BitmapError: The matrix or picture cannot be converted to a playpen.
        PortError: No robot stands in it.
        LogError: The log cannot be written.
    """
    global _open_playpen
    options = TwinOptions(seed=seed, robot=None, noise=noise, rom=rom, unpaced=True, log=log and str(log))
    loaded_playpen = with_lighting(_load_playpen(playpen), lighting)
    if not loaded_playpen.robots:
        raise PlaypenError(f"{loaded_playpen.name}: no robot stands in it; expected a [[robot]] in its file")
    close_playpen()
    _open_playpen = OpenPlaypen(open_twin(loaded_playpen, options))
    return _open_playpen


def close_playpen() -> None:
    """Close the playpen that is open and complete its log, RoboRunner's Close Playpen."""
    global _open_playpen
    if _open_playpen is not None:
        previous, _open_playpen = _open_playpen, None
        previous.twin.close()


def get_open_playpen(btmap1: object = None) -> OpenPlaypen:
    """Return the playpen that is open.

    Raises:
        PlaypenError: None is open, or another one than `btmap1`, unless that is None.
    """
    if _open_playpen is None:
        raise PlaypenError("no playpen is open; expected btmap1 = open_default(), or open_custom('NAME')")
    if btmap1 is not None and btmap1 is not _open_playpen:
        raise PlaypenError("btmap1 is not the playpen that is open; expected what open_custom has returned")
    return _open_playpen


@contextmanager
def use_twin_of(robot: Khepera) -> Generator[OpenPlaypen | None]:
    """Make a robot's twin in this process the open playpen within the context, and yield it.

    Yield None for a robot that is no twin in this process.
    """
    global _open_playpen
    previous, twin = _open_playpen, getattr(robot.port, "twin", None)
    if isinstance(twin, Twin) and (previous is None or robot not in previous.robots):
        _open_playpen = OpenPlaypen(twin, (robot,))
    try:
        yield _open_playpen if isinstance(twin, Twin) else None
    finally:
        _open_playpen = previous


def kheprom(btmap1: OpenPlaypen, cycle: float = CYCLE) -> None:
    """Advance the simulated robots by one cycle [s]."""
    get_open_playpen(btmap1).pass_time(cycle)


def upsv(btmap1: OpenPlaypen) -> None:
    """Convert all sensors of the simulated robots now; `kheprom` does so as time passes."""
    scan(get_open_playpen(btmap1).twin.world)


def ulsv() -> None:
    """Convert all sensors as `upsv` does; the lamps are those of the playpen that is open."""
    scan(get_open_playpen().twin.world)


def sim_skp(port_id: int, pos_left: SupportsFloat, pos_right: SupportsFloat) -> None:
    """Move the wheels to positions [pulses of 0.08 mm], also unequal ones."""
    serial_commands.skp(_get_robot(port_id), pos_left, pos_right)


def sim_sms(port_id: int, speed_left: SupportsFloat, speed_right: SupportsFloat) -> None:
    """Drive the wheels at separate speeds [pulses/10 ms = 8 mm/s]."""
    serial_commands.sms(_get_robot(port_id), speed_left, speed_right)


def sim_rms(port_id: int) -> Row:
    """Return the measured speed, left and right (2,) [pulses/10 ms], also in position mode."""
    return serial_commands.rms(_get_robot(port_id))


def sim_spc(port_id: int, pos_left: SupportsFloat, pos_right: SupportsFloat) -> None:
    """Set the position counters [pulses]."""
    serial_commands.spc(_get_robot(port_id), pos_left, pos_right)


def sim_rpc(port_id: int) -> Row:
    """Return the position counters of the left and the right wheel (2,) [pulses]."""
    return serial_commands.rpc(_get_robot(port_id))


def sim_rmc(port_id: int) -> Row:
    """Return motion control, [T, M, E] left and right (6,); M as for `rmc`, E is updated."""
    return serial_commands.rmc(_get_robot(port_id))


def sim_rps(port_id: int) -> Row:
    """Return proximity (8,), as last converted."""
    return serial_commands.rps(_get_robot(port_id))


def sim_rls(port_id: int) -> Row:
    """Return ambient light (8,), as last converted."""
    return serial_commands.rls(_get_robot(port_id))


def userdata(btmap1: OpenPlaypen, port_id: int = 1) -> NDArray[np.float64]:
    """Return the toolbox's data of the robot's drawing, in the order of its columns (31,).

    They are true x and y [mm] and rotation from 0 to 360 [degrees], proximity (8), light (8), the speed
    setpoints (2) [pulses/10 ms], [T, M, E] twice, position counters (2) and targets (2) [pulses].
    """
    simulator = get_open_playpen(btmap1)
    robot = simulator.twin.robots[simulator.index(port_id)]
    x, y, heading = robot.pose
    wheels = [robot.registers[side : side + len(Wheel)] for side in (LEFT, RIGHT)]
    return np.concatenate(
        [
            [x * 1e3, y * 1e3, np.degrees(heading) % 360],
            sim_rps(port_id),
            sim_rls(port_id),
            [wheel[Wheel.SPEED_SETPOINT] for wheel in wheels],
            sim_rmc(port_id),
            [wheel[Wheel.POSITION] for wheel in wheels],
            [wheel[Wheel.TARGET] for wheel in wheels],
        ]
    )


# Complete the log if the program does not close the playpen.
atexit.register(close_playpen)


def _get_robot(port_id: int) -> Khepera:
    simulator = get_open_playpen()
    return simulator.robots[simulator.index(port_id)]


def _load_playpen(source: StrPath | Playpen | NDArray[np.generic]) -> Playpen:
    """Return a playpen from any of its sources."""
    if isinstance(source, Playpen):
        return source
    if isinstance(source, np.ndarray):
        if source.ndim != 2:
            raise BitmapError(f"btmap1: {source.ndim} dimensions; expected a matrix, such as 500 x 600")
        # The toolbox scans upside down.
        return bitmap.to_playpen(source[::-1] == bitmap_files.SOLID, bitmap_files.SCAN).playpen
    path = Path(source)
    if path.suffix.lower() not in (".mat", ".png"):
        return Playpen.load(source)
    image = bitmap_files.read(path)
    solid = image.solid[::-1] if image.is_scan else image.solid
    try:
        return bitmap.to_playpen(solid, "imported").playpen
    except BitmapError as error:
        raise BitmapError(f"{path}: {error}") from None
