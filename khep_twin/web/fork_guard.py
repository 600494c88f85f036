"""Guard against forks: a controller's `os.fork` must not copy the designer's session."""

import os

from khep_twin.process.machine import n_forks


class ForkGuard:
    """Guard of the process that creates it."""

    def __init__(self) -> None:
        self._n_forks = n_forks()

    def exit_if_forked(self) -> None:
        """End this process immediately if it is a fork of the guarded one."""
        if n_forks() != self._n_forks:
            os._exit(0)
