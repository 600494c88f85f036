"""Models of the sensors: surfaces, optics of proximity, ambient light, calibrations."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from khep_twin.sensing.calibration import Calibration as Calibration
else:
    from khep_twin import lazy

    __getattr__, __dir__, __all__ = lazy.names(__name__)
