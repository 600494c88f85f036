"""Processes of rerun's viewer: a window, or a web page for this machine only; stills."""

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
from khep_twin.files.atomic import resolve
from khep_twin.files.drawings import write_drawing
from khep_twin.log.viewer.collected import TIMELINE
from khep_twin.process.signals import block_signals, register_cleanup

if TYPE_CHECKING:
    import rerun.experimental as rx

LOCALHOST = "127.0.0.1"
"""Address for data and pages; by default, rerun listens on all addresses of a machine."""

_START_TIMEOUT_S = 30.0
"""Longest wait for the viewer to listen: a cold start takes seconds (assumed) [s]."""

_POLL_INTERVAL_S = 0.05
"""Interval of checks of the viewer's process [s]."""

_OPENING_TIMEOUT_S = 30.0
"""Longest wait for the viewer to open a recording (assumed) [s]."""

_SETTLING_S = 1.0
"""Time after opening a recording until the pictures are stable [s]."""

_WIDTH = 1600
"""Width of a still [pixels]."""


@dataclass(frozen=True, slots=True)
class Web:
    """Settings of the viewer as a web page: `notify` takes its address, `browser` opens it in a browser."""

    notify: Callable[[str], None]
    browser: bool = True


class Viewer:
    """A running viewer.

    Attributes:
        address: Address that receives data, for rerun's `connect_grpc`.

    Raises:
        LogError: In `is_running` and the methods that wait: the viewer failed, or does not listen.
    """

    def __init__(self, name: str, process: "subprocess.Popen[bytes]", output: IO[bytes], port: int) -> None:
        self._log_name = name
        self._process = process
        self._output = output
        self.address = f"rerun+http://{LOCALHOST}:{port}/proxy"

    def is_closed(self) -> bool:
        """Return whether the viewer has exited, with or without an error."""
        return self._process.poll() is not None

    def is_running(self) -> bool:
        """Return whether the viewer is running; raise its error."""
        code = self._process.poll()
        if code:
            self._output.seek(0)
            lines = self._output.read().decode("utf-8", "replace").strip().splitlines()
            log, reason = self._log_name, (lines[-1] if lines else f"code {code}").removeprefix("Error: ")
            raise LogError(f"{log}: rerun's viewer failed: {reason}; {_alternatives(log)}")
        return code is None

    def wait(self, stop: Callable[[], bool]) -> None:
        """Wait until the window is closed, or `stop` returns True."""
        while not stop() and self.is_running():
            time.sleep(_POLL_INTERVAL_S)

    def wait_for_port(self, port: int, stop: Callable[[], bool]) -> None:
        """Wait until the viewer listens at a port, or `stop` returns True."""
        deadline = time.monotonic() + _START_TIMEOUT_S
        while not stop() and self.is_running():
            with suppress(OSError), socket.create_connection((LOCALHOST, port), timeout=1.0):
                return
            if time.monotonic() > deadline:
                raise LogError(
                    f"{self._log_name}: rerun's viewer does not listen after {_START_TIMEOUT_S:.0f} s"
                )
            time.sleep(_POLL_INTERVAL_S)


@contextmanager
def open_viewer(
    log_name: str, web: Web | None, recording: Path | None = None, stop: Callable[[], bool] = lambda: False
) -> Generator[Viewer, None, None]:
    """Open the viewer for a recording, or for data sent later, and terminate it on exit.

    Args:
        log_name: Name of the viewed log in messages.
        web: Settings of the viewer in a browser; None opens a window.
        recording: File of a rerun recording; None for data that is sent.
        stop: Function called repeatedly that returns whether to stop.

    Raises:
        LogError: There is no screen, or the viewer does not start.
    """
    if web is None and not _has_screen():
        raise LogError(f"{log_name}: there is no screen to open a window on; {_alternatives(log_name)}")
    port, web_port = free_ports(2)
    command = [sys.executable, "-m", "rerun", *([] if recording is None else [str(recording)])]
    command += ["--bind", LOCALHOST, "--port", str(port), "--server-memory-limit", "50%"]
    command += ["--expect-data-soon"] if web is None else ["--serve-web", "--web-viewer-port", str(web_port)]
    # The output goes to a file: a full pipe would block the viewer.
    with tempfile.TemporaryFile() as output:
        with block_signals():
            process = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=output, stderr=output, start_new_session=True
            )
            unregister = register_cleanup(partial(end_process, process))
        viewer = Viewer(log_name, process, output, port)
        try:
            if web is not None:
                viewer.wait_for_port(web_port, stop)
                address = f"http://{LOCALHOST}:{web_port}/?url={quote(viewer.address, safe='')}"
                web.notify(address)
                if web.browser and _has_screen():  # a browser in a terminal cannot show it
                    webbrowser.open(address)
            elif recording is None:
                viewer.wait_for_port(port, stop)
            yield viewer
        finally:
            end_process(process)
            unregister()


def free_ports(count: int) -> Sequence[int]:
    """Return free ports of this machine."""
    listeners = [socket.create_server((LOCALHOST, 0)) for _ in range(count)]
    ports = [int(listener.getsockname()[1]) for listener in listeners]
    for listener in listeners:
        listener.close()
    return ports


def end_process(process: "subprocess.Popen[bytes]") -> None:
    """Terminate a viewer and its child processes: rerun's command is a script around its program."""
    if sys.platform == "win32":
        process.terminate()
        return
    for number in (signal.SIGTERM, signal.SIGKILL):
        with suppress(ProcessLookupError):
            os.killpg(process.pid, number)
        with suppress(subprocess.TimeoutExpired):
            process.wait(timeout=5.0)
            return


def _has_screen() -> bool:
    return sys.platform != "linux" or bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def _alternatives(log_name: str) -> str:
    stem = Path(log_name).stem
    return (
        f"expected --web, for a browser, --png {stem}.png, for a picture, or --save {stem}.rrd, for a "
        "recording to open elsewhere"
    )


def write_still(recording: Path, at_s: float, target: Path, replace: bool) -> None:
    """Write a still of a recording in rerun's viewer at a time; `replace` as for `write_drawing`.

    Raises:
        LogError: The viewer does not start, does not answer or cannot draw.
    """
    # A window or a page is a separate process, so only stills import rerun here.
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
            _open_at(viewer, recording, at_s)
            picture = viewer.take_screenshot(max_size=_WIDTH)
        finally:
            with suppress(Exception):  # it may have exited
                viewer.quit()
    except Exception as error:  # rerun raises errors of many types, at the start or later
        reason, *_ = str(error).splitlines() or [type(error).__name__]
        raise LogError(
            f"{target}: rerun's viewer cannot draw here: {reason}; expected Vulkan, of a "
            "graphics driver or of the package mesa-vulkan-drivers"
        ) from error
    write_drawing(target, picture, replace)


def _open_at(viewer: "rx.ViewerClient", recording: Path, at_s: float) -> None:
    """Open a recording and wait until a time is shown."""
    viewer.open(str(resolve(recording)))
    deadline = time.monotonic() + _OPENING_TIMEOUT_S
    while True:
        try:
            viewer.set_time(TIMELINE, duration=at_s, play_state="paused")
            break
        except ConnectionError:
            raise
        except Exception:  # it has not read the recording yet
            if time.monotonic() > deadline:
                raise
            time.sleep(0.2)
    time.sleep(_SETTLING_S)
