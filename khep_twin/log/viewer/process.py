"""Viewer of rerun as its own process: a window, or a page for a browser, for this machine only; stills."""

# rerun's types are partly unknown.
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false

import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
import webbrowser
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import IO, TYPE_CHECKING
from urllib.parse import quote

from khep_twin.errors import LogError
from khep_twin.files.atomic import resolved
from khep_twin.files.drawings import write_drawing
from khep_twin.log.viewer.collected import TIMELINE
from khep_twin.signals import clear_at_end, undisturbed

if TYPE_CHECKING:
    import rerun.experimental as rx

HERE = "127.0.0.1"
"""Address for data and pages; by default, rerun listens on all of a machine's addresses."""

_START_TIMEOUT_S = 30.0
"""Longest wait for the viewer to listen: a cold start takes seconds (assumed) [s]."""

_TURN = 0.05
"""Interval of checks of the viewer's process [s]."""


@dataclass(frozen=True, slots=True)
class Web:
    """The viewer as a page, whose address `notify` takes; it is opened in a browser if that is wanted."""

    notify: Callable[[str], None]
    browser: bool = True


class Viewer:
    """A running viewer.

    Attributes:
        address: Address where it takes data, for rerun's `connect_grpc`.

    Raises:
        LogError: In `open` and all that wait: it failed, or does not listen.
    """

    def __init__(self, subject: str, process: "subprocess.Popen[bytes]", said: IO[bytes], port: int) -> None:
        self._subject, self._process, self._said = subject, process, said
        self.address = f"rerun+http://{HERE}:{port}/proxy"

    def closed(self) -> bool:
        """Return whether it has ended, with or without an error."""
        return self._process.poll() is not None

    def open(self) -> bool:
        """Return whether it still runs."""
        code = self._process.poll()
        if code:
            self._said.seek(0)
            lines = self._said.read().decode("utf-8", "replace").strip().splitlines()
            reason = lines[-1] if lines else f"code {code}"
            reason = reason.removeprefix("Error: ")
            raise LogError(f"{self._subject}: rerun's viewer failed: {reason}; {_expected(self._subject)}")
        return code is None

    def wait(self, stop: Callable[[], bool]) -> None:
        """Wait until its window is closed, or `stop` returns True."""
        while not stop() and self.open():
            time.sleep(_TURN)

    def wait_for(self, port: int, stop: Callable[[], bool]) -> None:
        """Wait until it listens at a port, or `stop` returns True."""
        deadline = time.monotonic() + _START_TIMEOUT_S
        while not stop() and self.open():
            with suppress(OSError), socket.create_connection((HERE, port), timeout=1.0):
                return
            if time.monotonic() > deadline:
                raise LogError(
                    f"{self._subject}: rerun's viewer does not listen after {_START_TIMEOUT_S:.0f} s"
                )
            time.sleep(_TURN)


@contextmanager
def open_viewer(
    subject: str,
    web: Web | None,
    recording: Path | None = None,
    stop: Callable[[], bool] = lambda: False,
) -> Generator[Viewer, None, None]:
    """Open the viewer on a recording, or on data sent to it later, and end it on exit.

    Args:
        subject: Name of the viewed log in messages.
        web: Settings of the viewer in a browser; None opens a window.
        recording: Recording of rerun, a file; None for data that is sent.
        stop: Function called now and then that returns whether to end.

    Raises:
        LogError: There is no screen, or it does not start.
    """
    if web is None and not _screen():
        raise LogError(f"{subject}: there is no screen to open a window on; {_expected(subject)}")
    port, page = free_ports(2)
    command = [sys.executable, "-m", "rerun", *([] if recording is None else [str(recording)])]
    command += ["--bind", HERE, "--port", str(port), "--server-memory-limit", "50%"]
    command += ["--expect-data-soon"] if web is None else ["--serve-web", "--web-viewer-port", str(page)]
    # Its output goes to a file: a pipe that is not read would block it.
    with tempfile.TemporaryFile() as said:
        with undisturbed():
            process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=said, stderr=said, start_new_session=True
            )
            forget = clear_at_end(partial(end_process, process))
        viewer = Viewer(subject, process, said, port)
        try:
            if web is not None:
                viewer.wait_for(page, stop)
                address = f"http://{HERE}:{page}/?url={quote(viewer.address, safe='')}"
                web.notify(address)
                if web.browser and _screen():  # a browser in a terminal cannot show it
                    webbrowser.open(address)
            elif recording is None:
                viewer.wait_for(port, stop)
            yield viewer
        finally:
            end_process(process)
            forget()


def free_ports(count: int) -> Sequence[int]:
    """Return free ports of this machine."""
    listeners = [socket.create_server((HERE, 0)) for _ in range(count)]
    ports = [int(listener.getsockname()[1]) for listener in listeners]
    for listener in listeners:
        listener.close()
    return ports


def end_process(process: "subprocess.Popen[bytes]") -> None:
    """End a viewer and its child processes: rerun's command is a script around its program."""
    if sys.platform == "win32":
        process.terminate()
        return
    for number in (signal.SIGTERM, signal.SIGKILL):
        with suppress(ProcessLookupError):
            os.killpg(process.pid, number)
        with suppress(subprocess.TimeoutExpired):
            process.wait(timeout=5.0)
            return


def _screen() -> bool:
    return sys.platform != "linux" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def _expected(subject: str) -> str:
    stem = Path(subject).stem
    return (
        f"expected --web, for a browser, --png {stem}.png, for a picture, or --save {stem}.rrd, for a "
        "recording to open elsewhere"
    )


_OPENING_TIMEOUT_S = 30.0
"""Longest wait for the viewer to have opened a recording (assumed) [s]."""

_PAINTING = 1.0
"""Time after that until its pictures are stable [s]."""

_WIDTH = 1600
"""Width of a still [pixels]."""


def still(recording: Path, at_s: float, target: Path, replace: bool) -> None:
    """Write a still of a recording in rerun's viewer at a time; `replace` as for `write_drawing`.

    Raises:
        LogError: The viewer does not start, does not answer or cannot draw.
    """
    # A window or a page is another process, which needs no rerun in this one.
    import rerun.experimental as rx

    # The viewer's output is hidden by default.
    os.environ.setdefault("RUST_LOG", "error")
    os.environ.setdefault("XDG_RUNTIME_DIR", tempfile.gettempdir())  # it warns if it is unset
    program = Path(sys.executable).with_name("rerun")
    try:
        viewer = rx.ViewerClient.spawn(
            headless=True,
            port=free_ports(1)[0],
            executable_path=str(program) if program.exists() else None,
            hide_welcome_screen=True,
        )
        try:
            _show(viewer, recording, at_s)
            picture = viewer.take_screenshot(max_size=_WIDTH)
        finally:
            with suppress(Exception):  # it may have ended by itself
                viewer.quit()
    except Exception as error:  # rerun's own errors are of many kinds, at the start or later
        raise LogError(
            f"{target}: rerun's viewer cannot draw here: {_first_line(error)}; expected Vulkan, of a "
            "graphics driver or of the package mesa-vulkan-drivers"
        ) from error
    write_drawing(target, picture, replace)


def _show(viewer: "rx.ViewerClient", recording: Path, at_s: float) -> None:
    """Open a recording and wait until a time of it is shown."""
    viewer.open(str(resolved(recording)))
    deadline = time.monotonic() + _OPENING_TIMEOUT_S
    while True:
        try:
            viewer.set_time(TIMELINE, duration=at_s, play_state="paused")
            break
        except ConnectionError:
            raise
        except Exception:  # it has not read the recording so far
            if time.monotonic() > deadline:
                raise
            time.sleep(0.2)
    time.sleep(_PAINTING)


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
