"""A running twin in a notebook: rerun's viewer below a cell, in the layout of a replay."""

# rerun's and IPython's types are partly unknown.
# pyright: reportMissingTypeStubs=false, reportMissingImports=false, reportUnknownMemberType=false
# pyright: reportUnknownVariableType=false, reportUnknownArgumentType=false

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray
from rerun import notebook

from khep_twin.clock import NS_PER_S
from khep_twin.errors import KhepTwinError, MissingExtraError
from khep_twin.log.entries import Entry, Label, make_label
from khep_twin.log.output import split_rows
from khep_twin.log.recorder import LiveRecorder
from khep_twin.log.viewer.layout import ShownLog, layout
from khep_twin.log.viewer.live import CURVE_LENGTH_S, Translator
from khep_twin.log.viewer.replay import static_chunks
from khep_twin.world import World

FLUSH_INTERVAL_WALL_NS = NS_PER_S // 5
"""Wall time between two flushes to the view, each at the next sample [ns]."""

_HEIGHT = 560
_NAME = Path("twin")


class RerunWriter:
    """Messages of a run for a recording of rerun; a `Writer`."""

    def __init__(self, recording: rr.RecordingStream) -> None:
        self._recording = recording
        self._folder = tempfile.TemporaryDirectory(prefix="khep-twin-")
        self._translator = Translator(Path(self._folder.name), _NAME)
        self._attachments: dict[str, str] = {}
        self._channels: list[tuple[str, str, str]] = []
        self._entries: list[Entry] = []
        self._label: Label | None = None

    def attach(self, name: str, text: str) -> None:
        """Save an attachment, from which the arena is drawn."""
        self._attachments[name] = text

    def describe(self, name: str, facts: Mapping[str, str]) -> None:
        """Send the layout and the static chunks."""
        self._label = make_label(_NAME, facts, self._attachments)
        self._recording.send_blueprint(layout([ShownLog(self._label, last_s=CURVE_LENGTH_S)]))
        rr.send_chunks(static_chunks(self._label), recording=self._recording)

    def channel(self, topic: str, schema: str, definition: str) -> int:
        """Return the ID of a topic's channel."""
        key = topic, schema, definition
        if key not in self._channels:
            self._channels.append(key)
        return self._channels.index(key)

    def add_lines(self, channel: int, times_ns: Sequence[int], messages: Sequence[bytes]) -> None:
        """Add messages of different sizes."""
        for time_ns, message in zip(times_ns, messages, strict=True):
            self._entries.append(Entry(*self._channels[channel], time_ns, message))

    def add_rows(self, channel: int, times_ns: NDArray[np.int64], messages: NDArray[np.void]) -> None:
        """Add messages of one size, one per row."""
        self.add_lines(channel, times_ns.tolist(), split_rows(messages))

    def flush(self) -> None:
        """Send the added messages; of samples, 25 per simulated second."""
        entries, self._entries = self._entries, []
        if entries and self._label is not None:
            static, timed = self._translator.translate(entries, self._label)
            rr.send_chunks([*static, *timed], recording=self._recording)

    def finish(self) -> None:
        """Send the rest."""
        self.flush()
        self._folder.cleanup()


class NotebookView(LiveRecorder):
    """View of a world in the notebook that runs the program.

    Args:
        world: World to show.
        settings: Configuration of the run.

    Raises:
        KhepTwinError: The program is no Jupyter notebook.
        MissingExtraError: rerun's part for notebooks is not installed.
    """

    def __init__(self, world: World, settings: Mapping[str, object]) -> None:
        shell = _shell()
        if not notebook.HAS_NOTEBOOK:
            raise MissingExtraError("rerun-notebook", "notebook")
        recording = rr.RecordingStream("khep_twin", recording_id=f"{world.playpen.name} {id(world)}")
        self._viewer = notebook.Viewer(recording=recording, width="auto", height=_HEIGHT)
        writer = RerunWriter(recording)
        super().__init__(writer, world, settings, flush_interval_wall_ns=FLUSH_INTERVAL_WALL_NS)
        shell.events.register("post_run_cell", self._flush_after_cell)

    def display(self) -> None:
        """Show the viewer below the present cell."""
        self._viewer.display()

    def _flush_after_cell(self, _: object) -> None:
        self.flush()


def _shell() -> Any:
    """Return the notebook's shell."""
    try:
        from IPython.core.getipython import get_ipython
    except ImportError:
        shell = None
    else:
        shell = get_ipython()
    if shell is None or not hasattr(shell, "kernel"):
        raise KhepTwinError(
            "show() draws below a cell of a notebook; expected a notebook of Jupyter, or a log of the run "
            "and khep-twin view --live FILE.mcap"
        )
    return shell
