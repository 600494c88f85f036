"""Calibrations fitted to measurements of one robot."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from khep_twin.lab.fit.fit_inputs import fit_inputs as fit_inputs
    from khep_twin.lab.fit.robot_fit import RobotFit as RobotFit
    from khep_twin.lab.fit.robot_fit import fit_robot as fit_robot
else:
    from khep_twin import lazy

    __getattr__, __dir__, __all__ = lazy.names(__name__)
