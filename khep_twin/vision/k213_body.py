"""The K213 turret in a world: images of its camera, and readings of its light sensor."""

from importlib.resources import files
from pathlib import Path

from khep_twin.board.k213 import PIXELS, RANGES, REVISION, TICK_MS, VERSION, K213Electronics, K213Register
from khep_twin.board.turrets import TurretContext, TurretKind
from khep_twin.sensing.line_faces import fixed_faces, moving_faces, read_poses
from khep_twin.units import K213_NUMBER, K213_PIXELS
from khep_twin.vision.camera import LineCamera, eye_of


class K213Body:
    """K213 of one robot in a compiled scene, a `TurretBody`.

    An image shows the scene at the end of a scan: motion during the scan does not blur it.
    """

    def __init__(self, context: TurretContext) -> None:
        model = context.model
        self._context = context
        self._view = context.registers.data
        self._pixels = context.registers[PIXELS]
        self._eye_camera = model.camera(context.prefix + "eye").id
        moving = moving_faces(model, int(model.cam_bodyid[self._eye_camera]))
        self._camera = LineCamera(fixed_faces(model), moving, read_poses(context.data))

    def sense(self) -> None:
        """Take an image where a scan ends in this control period."""
        view, context = self._view, self._context
        if view[K213Register.LEFT] > 1:
            return
        view[K213Register.LIGHT] = self._camera.take(
            eye_of(context.data, self._eye_camera),
            self._pixels,
            context.lamps,
            context.room_lux,
            view[K213Register.SCAN] * TICK_MS,
            context.key,
            view[K213Register.SCANS],
            noise=context.noise,
            compiled=context.is_compiled,
        )

    def drive(self) -> None:
        """Do nothing, as the turret has no motors."""


K213 = TurretKind(
    name="k213",
    number=K213_NUMBER,
    description="linear vision, 64 pixels",
    revision=f"{VERSION}.{REVISION}",
    make=K213Electronics,
    scene=Path(str(files("khep_twin"))) / "assets" / "k213.xml",
    fit=K213Body,
    height=None,  # its camera is on top (assumed)
    names=(
        *(register.name.lower() for register in K213Register),
        *(f"pixel_{k}" for k in range(K213_PIXELS)),
    ),
    image=PIXELS,
    ranges=RANGES,
)
"""The K213, as registered under the entry point "khep_twin.turrets"."""
