"""The Khepera Toolbox's simulated commands, on a twin in lock-step.

    btmap1 = open_default(seed=1)       # or open_custom("obstacles"), open_custom("scan.mat")
    sim_sms(2, 1, 1)
    a = sim_rps(2)
    kheprom(btmap1)                     # 50 ms pass

A command takes no time at all: it reaches the board's registers at once and is answered from them, and what
it started happens while `kheprom` lets time pass. Between two of them time stands still for the robot. It is
the board and the physics of every other twin: speeds have sizes, wheels differ, counters count pulses.

One playpen is open at a time, as in the toolbox; what needs it raises a `PlaypenError` without it, and for a
`btmap1` that is another one. In one with a single robot `port_id` is ignored; where
there are several it is the robot's number, from 1.
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
"""Cycle of `kheprom` by default [s] (assumed: about what `rps` and `sms` take on a robot)."""


class OpenPlaypen:
    """Playpen that is open in the simulator: the `btmap1` that a program passes on.

    Its `twin` has the ground truth, its `robots` are the host's ends of lines that take no time.
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
        """Return the index of the robot that a port's number stands for, from 0."""
        if len(self.robots) == 1:
            return 0
        numbers = range(1, len(self.robots) + 1)
        if port_id not in numbers:
            found = f"port_id = {port_id!r}: no such robot"
            raise PortError(found, key="port_id", value=port_id, expected=numbers)
        return int(port_id) - 1

    def pass_time(self, duration: float) -> None:
        """Let time pass [s]."""
        self.twin.advance_to(self.twin.world.time_ns + to_ns(duration))


def open_default(
    *,
    seed: int = 0,
    noise: bool = True,
    rom: str | None = None,
    lighting: str | None = None,
    log: StrPath | None = None,
) -> OpenPlaypen:
    """Open four walls with a robot in their middle, RoboRunner's Open Default; close what was open.

    The arguments are those of `open_custom`; lamps come by `place_lamp`.
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
    """Open a playpen, RoboRunner's Open Custom; close what was open.

    Args:
        playpen: Name of a shipped one, a playpen file, a scanned MAT file of the toolbox or a PNG, or the
            matrix `btmap1` of one (rows, columns), 44 where something stands, its first row at the bottom.
        seed: Seed of every random stream.
        noise: Add noise to the sensors.
        rom: Version of the robots' ROM, if not the playpen's; with "4.06" `sim_rmc` has the toolbox's modes.
        lighting: Lamp Control, "all", "random" or "sequenced", or "off" for no lamps at all; without, as the
            playpen has it.
        log: File to record the run in.

    Raises:
        PlaypenError: It cannot be used.
        BitmapError: The matrix or picture cannot become a playpen.
        PortError: No robot stands in it.
        LogError: The log cannot be written.
    """
    global _current
    options = TwinOptions(seed=seed, robot=None, noise=noise, rom=rom, unpaced=True, log=log and str(log))
    chosen = with_lighting(_playpen(playpen), lighting)
    if not chosen.robots:
        raise PlaypenError(f"{chosen.name}: no robot stands in it; expected a [[robot]] in its file")
    close_playpen()
    _current = OpenPlaypen(open_twin(chosen, options))
    return _current


def close_playpen() -> None:
    """Close the playpen that is open and complete its log, RoboRunner's Close Playpen."""
    global _current
    if _current is not None:
        before, _current = _current, None
        before.twin.close()


def opened(btmap1: object = None) -> OpenPlaypen:
    """Return the playpen that is open.

    Raises:
        PlaypenError: None is open, or another one than `btmap1`, unless that is None.
    """
    if _current is None:
        raise PlaypenError("no playpen is open; expected btmap1 = open_default(), or open_custom('NAME')")
    if btmap1 is not None and btmap1 is not _current:
        raise PlaypenError("btmap1 is not the playpen that is open; expected what open_custom has returned")
    return _current


@contextmanager
def opened_for(robot: Khepera) -> Generator[OpenPlaypen | None]:
    """Let the twin in this process behind a robot be the playpen that is open, within the context.

    It is None for a robot that is no twin in this process.
    """
    global _current
    before, twin = _current, getattr(robot.port, "twin", None)
    if isinstance(twin, Twin) and (before is None or robot not in before.robots):
        _current = OpenPlaypen(twin, (robot,))
    try:
        yield _current if isinstance(twin, Twin) else None
    finally:
        _current = before


def kheprom(btmap1: OpenPlaypen, cycle: float = CYCLE) -> None:
    """Advance the simulated robots by one cycle [s]."""
    opened(btmap1).pass_time(cycle)


def upsv(btmap1: OpenPlaypen) -> None:
    """Convert all sensors of the simulated robots as of now; `kheprom` does so by itself as time passes."""
    scan(opened(btmap1).twin.world)


def ulsv() -> None:
    """Convert all sensors as `upsv` does; the lamps are those of the playpen that is open."""
    scan(opened().twin.world)


def sim_skp(port_id: int, pos_left: SupportsFloat, pos_right: SupportsFloat) -> None:
    """Send the wheels to these positions [pulses of 0.08 mm], any mixture of path and turn."""
    serial_commands.skp(_robot(port_id), pos_left, pos_right)


def sim_sms(port_id: int, speed_left: SupportsFloat, speed_right: SupportsFloat) -> None:
    """Drive the wheels at these speeds [pulses/10 ms = 8 mm/s], each at its own."""
    serial_commands.sms(_robot(port_id), speed_left, speed_right)


def sim_rms(port_id: int) -> Row:
    """Return the measured speed, left and right (2,) [pulses/10 ms], in position mode, too."""
    return serial_commands.rms(_robot(port_id))


def sim_spc(port_id: int, pos_left: SupportsFloat, pos_right: SupportsFloat) -> None:
    """Set the position counters [pulses]."""
    serial_commands.spc(_robot(port_id), pos_left, pos_right)


def sim_rpc(port_id: int) -> Row:
    """Return the position counters of the left and the right wheel (2,) [pulses]."""
    return serial_commands.rpc(_robot(port_id))


def sim_rmc(port_id: int) -> Row:
    """Return motion control, [T, M, E] left and right (6,); M as `rmc` has it, E is updated."""
    return serial_commands.rmc(_robot(port_id))


def sim_rps(port_id: int) -> Row:
    """Return proximity (8,), as last converted."""
    return serial_commands.rps(_robot(port_id))


def sim_rls(port_id: int) -> Row:
    """Return ambient light (8,), as last converted."""
    return serial_commands.rls(_robot(port_id))


def userdata(btmap1: OpenPlaypen, port_id: int = 1) -> NDArray[np.float64]:
    """Return the toolbox's data of the robot's drawing: 31 numbers in its columns' order (31,).

    They are true x and y [mm] and rotation from 0 to 360 [degrees], proximity (8), light (8), the speeds that
    are set (2) [pulses/10 ms], [T, M, E] twice, position counters (2) and targets (2) [pulses].
    """
    scene = opened(btmap1)
    robot = scene.twin.robots[scene.index(port_id)]
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


_current: OpenPlaypen | None = None
# A log is whole though the program forgot to close the playpen.
atexit.register(close_playpen)


def _robot(port_id: int) -> Khepera:
    scene = opened()
    return scene.robots[scene.index(port_id)]


def _playpen(source: StrPath | Playpen | NDArray[np.generic]) -> Playpen:
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
    found = bitmap_files.read(path)
    solid = found.solid[::-1] if found.scanned else found.solid
    try:
        return bitmap.to_playpen(solid, "imported").playpen
    except BitmapError as error:
        raise BitmapError(f"{path}: {error}") from None
