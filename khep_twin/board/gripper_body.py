"""Body of the gripper in the physics: arm and fingers with motors, light barrier and resistivity sensor."""

import math
from importlib.resources import files
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from khep_twin.board.gripper import FRACTION, RANGES, REVISION, VERSION, GripperElectronics, Register
from khep_twin.board.terms import Term
from khep_twin.board.turrets import TurretContext, TurretKind
from khep_twin.units import ARM_DOWN, ARM_UP, FINGERS_OPEN, GRIPPER_NUMBER

ARM_DEGREES_PER_UNIT = 200 / 255
"""Angle per position of the arm: elevation = 190 - 200 position / 255 [deg] (a simulator's model)."""

ARM_LEVEL_DEG = 190.0
"""Elevation by the same formula at position 0 [deg] (the same model)."""

GAP_CLOSED, GAP_OPEN = 0.0005, 0.0275
"""Half of the gap between the fingers at positions 0 and 200 [m] (the same model)."""

SERIES_RESISTANCE = 10_000.0
"""Resistance in series with the gripped object, to measure its resistance [ohm] (assumed)."""

FINGER_THICKNESS = 0.003
"""Thickness of a finger in assets/gripper.xml [m]: the light barrier's rays start behind its face."""

BOARD_HEIGHT = 0.008
"""Height of the board in assets/gripper.xml, on which another turret stands [m] (assumed)."""

N_RAYS = 3
"""Number of the light barrier's rays in assets/gripper.xml."""

_FREE_TOLERANCE = 0.0005
"""Distance from the right finger within which a ray counts as unobstructed [m]."""


class GripperBody:
    """Gripper of one robot in a compiled scene, a `TurretBody`.

    Args:
        context: Interface to the world.
    """

    def __init__(self, context: TurretContext) -> None:
        model, prefix = context.model, context.prefix
        self._data = context.data
        self._register_view = context.registers.data
        self._shoulder_qpos, self._slide_qpos = (
            int(model.joint(prefix + name).qposadr[0]) for name in ("shoulder", "left_slide")
        )
        self._arm_motor, self._finger_motor = (
            model.actuator(prefix + name).id for name in ("shoulder_motor", "finger_motor")
        )
        self._beam_addresses = [int(model.sensor(f"{prefix}beam_{ray}").adr[0]) for ray in range(N_RAYS)]
        self._pads = [model.geom(prefix + name).id for name in ("left_pad", "right_pad")]
        self._conductances: NDArray[np.float64] = model.geom_user[:, 1]
        self.drive()

    def sense(self) -> None:
        """Read positions, light barrier and resistivity into the registers."""
        qpos, view = self._data.qpos, self._register_view
        elevation_deg = math.degrees(qpos[self._shoulder_qpos])
        half_gap = float(qpos[self._slide_qpos])
        view[Register.ARM_POSITION] = round((ARM_LEVEL_DEG - elevation_deg) / ARM_DEGREES_PER_UNIT)
        position = (half_gap - GAP_CLOSED) / (GAP_OPEN - GAP_CLOSED) * FINGERS_OPEN
        view[Register.FINGER_POSITION] = min(max(round(position), 0), FINGERS_OPEN)
        gap = 2 * half_gap + FINGER_THICKNESS - _FREE_TOLERANCE
        n_dark = sum(0 <= self._data.sensordata[ray] < gap for ray in self._beam_addresses)
        view[Register.BARRIER] = n_dark * 255 // N_RAYS
        view[Register.RESISTIVITY] = resistivity(self._conductance())

    def drive(self) -> None:
        """Drive arm and fingers to the setpoints."""
        arm = self._register_view[Register.ARM_SETPOINT] / FRACTION
        fingers = self._register_view[Register.FINGER_SETPOINT] / FRACTION
        elevation_deg = ARM_LEVEL_DEG - ARM_DEGREES_PER_UNIT * arm
        self._data.ctrl[self._arm_motor] = math.radians(elevation_deg)
        self._data.ctrl[self._finger_motor] = GAP_CLOSED + (GAP_OPEN - GAP_CLOSED) * fingers / FINGERS_OPEN

    def _conductance(self) -> float:
        """Return the conductance of the object that both fingers touch [S]; 0 without one."""
        pairs: NDArray[np.int32] = self._data.contact.geom
        touching = pairs.ravel().tolist()
        if not all(pad in touching for pad in self._pads):
            return 0.0
        left_geoms, right_geoms = (
            {int(geom) for geom in pairs[(pairs == pad).any(axis=1)].ravel()} - {pad} for pad in self._pads
        )
        return max((float(self._conductances[geom]) for geom in left_geoms & right_geoms), default=0.0)


def resistivity(conductance: float) -> int:
    """Return the reading for a conductance [S]: R / (R + series resistance), scaled to 0 to 255."""
    return round(255 / (1 + SERIES_RESISTANCE * conductance))


_BUS = "1", "gripper"
_ARM, _FINGERS = (ARM_UP, ARM_DOWN, *_BUS), (0, FINGERS_OPEN, *_BUS)
"""Lowest and highest position, unit and turret of the terms."""


def _move_fingers(position: int) -> str:
    return f"D,{int(position < FINGERS_OPEN / 2)}"


GRIPPER = TurretKind(
    name="gripper",
    number=GRIPPER_NUMBER,
    description="arm with two fingers",
    revision=f"{VERSION}.{REVISION}",
    make=GripperElectronics,
    scene=Path(str(files("khep_twin"))) / "assets" / "gripper.xml",
    fit=GripperBody,
    reach=0.034,
    height=BOARD_HEIGHT,
    is_lowest=True,
    names=tuple(register.name.lower() for register in Register),
    ranges=RANGES,
    terms=(
        Term("gripper_barrier", Register.BARRIER, ("barrier",), 0, 255, *_BUS, "G"),
        Term("gripper_resistivity", Register.RESISTIVITY, ("resistivity",), 0, 255, *_BUS, "F"),
        Term("gripper_fingers", Register.FINGER_POSITION, ("fingers",), *_FINGERS, "H,0", _move_fingers),
        Term("gripper_arm", Register.ARM_POSITION, ("arm",), *_ARM, "H,1", "E,{}".format),
    ),
)
"""The gripper, as registered under the entry point "khep_twin.turrets"."""
