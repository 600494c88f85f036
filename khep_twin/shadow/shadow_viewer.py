"""The rerun viewer of a shadow: a separate process that follows a log, as `khep-twin view --live` does.

    with ShadowViewer(playpen, settings) as viewer:
        for update in shadow.feed(...):
            viewer.show(update)
        viewer.wait(stop)

The shadow only writes a file, so drawing costs it no time and does not delay a relay.
"""

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Self

from khep_twin.log.viewer.process import end_process
from khep_twin.playpen import Playpen
from khep_twin.process.signals import block_signals, register_cleanup
from khep_twin.process.status_line import STATUS_LINE_VARIABLE
from khep_twin.shadow.shadow import ShadowSettings
from khep_twin.shadow.shadow_log import LIVE_FLUSH_NS, ShadowLog
from khep_twin.shadow.update import Update

_POLL_S = 0.05
"""Interval of checks of the viewer's process [s]."""


class ShadowViewer:
    """A viewer that shows a running shadow.

    Args:
        playpen: Playpen of the shadow.
        settings: Settings of the shadow.
        log: Path of a `ShadowLog` that is flushed every `LIVE_FLUSH_NS`; None for a temporary one.
        web: Show it in a browser instead of a window.

    Raises:
        LogError: The temporary log cannot be made.
    """

    def __init__(
        self, playpen: Playpen, settings: ShadowSettings, log: Path | None = None, *, web: bool = False
    ) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="khep-twin-")
        self._log: ShadowLog | None = None
        if log is None:
            log = Path(self._folder.name) / "shadow.mcap"
            self._log = ShadowLog(log, playpen, settings, flush_ns=LIVE_FLUSH_NS)
        command = [sys.executable, "-m", "khep_twin", "view", "--live", str(log), *(["--web"] if web else [])]
        with block_signals():
            # Ctrl-C in a terminal is for the shadow, which then ends the viewer.
            env = {**os.environ, STATUS_LINE_VARIABLE: "1"}
            self._process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, start_new_session=True, env=env
            )
            self._unregister = register_cleanup(self.close)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def show(self, update: Update) -> None:
        """Show an update; with a log of the caller, the viewer reads it there."""
        if self._log is not None:
            self._log.write(update)

    def is_closed(self) -> bool:
        """Return whether the viewer has ended."""
        return self._process.poll() is not None

    def wait(self, stop: Callable[[], bool]) -> None:
        """Wait until the viewer is closed, or `stop` returns True."""
        if self._log is not None:
            self._log.flush()
        while not stop() and not self.is_closed():
            time.sleep(_POLL_S)

    def close(self) -> None:
        """End the viewer, and remove the temporary log."""
        end_process(self._process)
        self._unregister()
        if self._log is not None:
            self._log.discard()
        with suppress(OSError):
            self._folder.cleanup()
