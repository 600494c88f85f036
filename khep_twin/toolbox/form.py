"""Detection of controllers in the toolbox's form, without loading the toolbox."""

import inspect

from khep_twin.lab.experiment.controllers import AnyController


def as_toolbox_form(controller: AnyController) -> AnyController:
    """Wrap a function of `port_id, cycles_per_run, runs, pause_stat` as a controller; keep others."""
    if not inspect.isfunction(controller) or len(inspect.signature(controller).parameters) != 4:
        return controller
    # Imported here, as the toolbox's simulator loads slowly.
    from khep_twin.toolbox.controller import ToolboxController

    return ToolboxController(controller)
