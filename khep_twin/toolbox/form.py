"""The toolbox's form of a controller, recognized without loading the toolbox."""

import inspect

from khep_twin.lab.experiment.controllers import AnyController


def as_toolbox_form(controller: AnyController) -> AnyController:
    """Make a controller of a function of `port_id, cycles_per_run, runs, pause_stat`; others stay."""
    if not inspect.isfunction(controller) or len(inspect.signature(controller).parameters) != 4:
        return controller
    # Here, as the toolbox's simulator takes its time to load.
    from khep_twin.toolbox.controller import ToolboxController

    return ToolboxController(controller)
