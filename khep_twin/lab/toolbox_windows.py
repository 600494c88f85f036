"""Windows for the Khepera Toolbox's pictures, where there is a screen."""

# matplotlib's own annotations leave keyword arguments open.
# pyright: reportUnknownMemberType=false

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def show(figure: "Figure", title: str) -> bool:
    """Opens a window with a figure and goes on at once.

    Returns:
        Whether there is one: matplotlib must have found a screen, or been told of one.
    """
    import matplotlib
    from matplotlib.backends.registry import BackendFilter, backend_registry

    name = matplotlib.get_backend()
    if name.lower() not in backend_registry.list_builtin(BackendFilter.INTERACTIVE):
        return False
    canvas: Any = backend_registry.load_backend_module(name).FigureCanvas  # pyright: ignore
    manager: Any = canvas.new_manager(figure, len(_windows) + 1)
    manager.set_window_title(title)
    manager.show()
    _windows.append(manager)
    figure.canvas.mpl_connect("close_event", lambda _: _windows.remove(manager))
    refresh(figure)
    return True


def refresh(figure: "Figure") -> None:
    """Brings a window up to date, unless somebody has closed it."""
    if any(manager.canvas is figure.canvas for manager in _windows):
        figure.canvas.draw()
        figure.canvas.flush_events()


_windows: list[Any] = []
"""Kept, because a window that nobody holds is closed."""
