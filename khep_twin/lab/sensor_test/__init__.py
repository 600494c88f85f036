"""Sensor tests: readings while a robot turns or drives."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from khep_twin.lab.sensor_test.sensor_files import load as load
    from khep_twin.lab.sensor_test.sensor_files import save as save
    from khep_twin.lab.sensor_test.sensor_test import SensorRun as SensorRun
    from khep_twin.lab.sensor_test.sensor_test import SensorTest as SensorTest
    from khep_twin.lab.sensor_test.sensor_test import sense as sense
else:
    from khep_twin import lazy

    __getattr__, __dir__, __all__ = lazy.names(__name__)
