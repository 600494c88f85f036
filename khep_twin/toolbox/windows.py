"""Windows for the Khepera Toolbox's pictures, where there is a screen.

They stay open after the end of a program, until the user closes them or presses Ctrl-C.
"""

# matplotlib's own annotations leave keyword arguments open.
# pyright: reportUnknownMemberType=false

import atexit
import sys
import time
from typing import TYPE_CHECKING

from khep_twin.toolbox.serial_commands import ports
from khep_twin.toolbox.simulator import close_playpen

if TYPE_CHECKING:
    from matplotlib.backend_bases import FigureCanvasBase, FigureManagerBase
    from matplotlib.figure import Figure

_EVENT_INTERVAL_S = 0.03
"""Interval at which the windows' events are handled [s]."""

_windows: list["FigureManagerBase"] = []
"""Open windows; matplotlib closes a window without a reference."""


def show(figure: "Figure", title: str) -> bool:
    """Open a window with a figure without waiting; return False if matplotlib finds no screen."""
    import matplotlib
    from matplotlib.backends.registry import BackendFilter, backend_registry

    name = matplotlib.get_backend()
    if name.lower() not in backend_registry.list_builtin(BackendFilter.INTERACTIVE):
        return False
    canvas: type[FigureCanvasBase] = backend_registry.load_backend_module(name).FigureCanvas  # pyright: ignore
    manager = canvas.new_manager(figure, len(_windows) + 1)
    manager.set_window_title(title)
    manager.show()
    _windows.append(manager)
    figure.canvas.mpl_connect("close_event", lambda _: _windows.remove(manager))
    refresh(figure)
    return True


def refresh(figure: "Figure") -> None:
    """Redraw a window, unless the user has closed it."""
    if any(manager.canvas is figure.canvas for manager in _windows):
        figure.canvas.draw()
        figure.canvas.flush_events()


def wait_until_closed() -> None:
    """Wait until the user has closed the windows of a program that has ended, with its robots at rest.

    Do not wait at a prompt, which keeps the windows open, and after an error or Ctrl-C.
    """
    has_failed = hasattr(sys, "last_type")
    if not _windows or has_failed or hasattr(sys, "ps1") or sys.flags.interactive:
        return
    ports({})
    close_playpen()
    print("the program has ended; close its windows, or press Ctrl-C", file=sys.stderr)
    try:
        while _windows:
            _windows[-1].canvas.flush_events()
            time.sleep(_EVENT_INTERVAL_S)
    except KeyboardInterrupt:
        _windows.clear()


atexit.register(wait_until_closed)
