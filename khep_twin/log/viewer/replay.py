"""View of finished logs in rerun: arena, curves and transcript on one time axis, several logs side by side.

rerun reads logs by itself. This module adds a layout made for this robot, and time as seconds of the run
instead of dates in 1970; both go into a rerun recording, which is saved or shown.
"""

# rerun and pyarrow are not typed, or in part.
# pyright: reportMissingTypeStubs=false
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false

import tempfile
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import Any

import pyarrow as pa
import rerun as rr
from rerun.chunk import Chunk

from khep_twin.clock import NS_PER_S
from khep_twin.errors import LogError
from khep_twin.files.atomic import is_same, part_file, resolved
from khep_twin.files.text import encodable
from khep_twin.log.attached import bodies_of, playpen_of, shapes_of
from khep_twin.log.mcap_recovery import Progress
from khep_twin.log.reader import Label, read_end_ns, read_with_messages
from khep_twin.log.shadow_channels import is_shadow
from khep_twin.log.viewer.arena import TRAIL, FloorLight, Rays, event_chunks, path_chunks, trail
from khep_twin.log.viewer.collected import Collector, Floats, Samples, times_of
from khep_twin.log.viewer.ghost import Ghost
from khep_twin.log.viewer.khepera4 import arena_chunks
from khep_twin.log.viewer.layout import Shown, layout
from khep_twin.log.viewer.process import Web, open_viewer, still
from khep_twin.log.viewer.robot_panel import (
    INTERVAL_NS,
    SAMPLES_PER_PICTURE,
    Strips,
    outline_chunks,
    panel_chunks,
)
from khep_twin.log.viewer.thinning import Copy, interval_ns

Bar = Callable[[], AbstractContextManager[Progress]]
"""Function that makes a context in which progress is shown."""

UNSEEN = ["/host_events$", "^/state$", "/registers$", "^/scene$", "^/channel_names$"]
"""Topics, as patterns, that no view shows: data for programs, or contained in the views themselves."""

PICTURES = 10_000
"""Most pictures of bars, rays and strips of a run; a longer one has fewer than ten a second."""

_FRAMES = ("Transform3D:child_frame", "Transform3D:parent_frame", "CoordinateFrame:frame")


def view(
    paths: Sequence[Path],
    save: Path | None = None,
    web: Web | None = None,
    stop: Callable[[], bool] = lambda: False,
    bar: Bar = nullcontext,
    replace: bool = True,
) -> None:
    """Show logs in rerun's viewer until its window is closed, or save them as one rerun recording.

    Args:
        paths: Paths of finished logs, from left to right.
        save: Path of the recording, by convention NAME.rrd; None opens the viewer.
        web: Settings of the viewer in a browser; None opens a window.
        stop: Function called now and then that returns whether to end.
        bar: Function that makes a progress bar, such as `cli_progress.progress`.
        replace: True to replace a file that is there when the recording is written.

    Raises:
        LogError: A log cannot be read, the recording cannot be written, or no window opens.
    """
    if save is not None:
        _save(paths, save, bar, replace)
        return
    with _saved(paths, bar) as recording, open_viewer(str(paths[0]), web, recording) as viewer:
        viewer.wait(stop)


def view_still(
    paths: Sequence[Path],
    target: Path,
    at_s: float | None = None,
    bar: Bar = nullcontext,
    replace: bool = True,
) -> None:
    """Write a still of logs, from left to right, in the viewer as PNG, without a screen.

    It is at a simulated time [s]; for None at the end, where the whole run is seen. `replace` is as for
    `write_drawing`.

    Raises:
        LogError: A log cannot be read, or the viewer is not available.
    """
    with _saved(paths, bar) as recording:
        end_s = max(map(read_end_ns, paths)) / NS_PER_S
        still(recording, end_s if at_s is None else at_s, target, replace)


def standing_chunks(label: Label) -> list[Chunk]:
    """Return the static chunks that are added to a log's own."""
    panels = "playpen.toml" in label.attachments and not is_shadow(label)
    bodies = bodies_of(label.attachments, label.robots, "log") if panels else {}
    return [chunk for robot, body in bodies.items() for chunk in outline_chunks(robot, body)]


def distinct_names(paths: Sequence[Path]) -> list[str]:
    """Return the files' names without suffix; equal ones with their folders, or else with numbers."""
    stems = [encodable(path.stem) for path in paths]
    names = [
        stem if stems.count(stem) == 1 else f"{encodable(resolved(path).parent.name)}/{stem}"
        for path, stem in zip(paths, stems, strict=True)
    ]
    seen: Counter[str] = Counter()
    distinct: list[str] = []
    for name in names:
        seen[name] += 1
        distinct.append(name if names.count(name) == 1 else f"{name} {seen[name]}")
    return distinct


def _checked(path: Path, copy: Path, progress: Progress) -> Label:
    """Check a log and copy its shown parts; return its label."""
    label, moves = None, False
    with copy.open("xb") as file:
        writer = Copy(file, interval_ns(read_end_ns(path)), UNSEEN)
        for recording, messages in read_with_messages(path, progress):
            label = recording.label
            writer.add(messages)
            moves |= any(f"/{robot}/pose" in recording.series for robot in label.robots)
        assert label is not None  # there is at least one piece
        writer.finish(label)
    if moves or "playpen.toml" in label.attachments:
        playpen_of(label.attachments, path)
    if moves:
        shapes_of(label.attachments, label.robots, path)
    return label


@contextmanager
def _saved(paths: Sequence[Path], bar: Bar) -> Generator[Path, None, None]:
    """Provide a temporary recording."""
    with tempfile.TemporaryDirectory(prefix="khep-twin-") as folder:
        recording = Path(folder) / f"{encodable(paths[0].stem)}.rrd"
        _save(paths, recording, bar)
        yield recording


def _save(paths: Sequence[Path], save: Path, bar: Bar, replace: bool = True) -> None:
    if save.is_dir() or any(is_same(save, path) for path in paths):
        what = "a directory" if save.is_dir() else "the log itself"
        raise LogError(f"{save}: this is {what}; expected the name of a file, such as {paths[0].stem}.rrd")
    # Each log is read twice: to be checked and copied, and by rerun.
    count = 2 * len(paths)
    try:
        with bar() as progress, tempfile.TemporaryDirectory(prefix="khep-twin-") as folder:
            shares = [_share_of(progress, number, count) for number in range(count)]
            copies = [Path(folder) / f"{number}.mcap" for number in range(len(paths))]
            labels = [_checked(*each) for each in zip(paths, copies, shares, strict=False)]
            recording = _recording(paths, copies, labels, shares[len(paths) :])
        with part_file(save, replace) as file:
            file.write(recording)
    except OSError as error:
        raise LogError(f"{save}: the recording cannot be written: {error.strerror}") from error


def _share_of(progress: Progress, number: int, count: int) -> Progress:
    """Return a function that takes the progress of one of `count` parts."""
    return None if progress is None else lambda share: progress((number + share) / count)


def _recording(
    paths: Sequence[Path], copies: Sequence[Path], labels: Sequence[Label], shares: Sequence[Progress]
) -> bytes:
    """Return the logs and their layout as the bytes of a rerun file.

    Made in memory, because rerun itself may wait for ever for a disk that is full.
    """
    names = distinct_names(paths)
    title = " and ".join(names)
    with rr.RecordingStream("khep_twin", recording_id=title) as recording:
        stream = recording.binary_stream()
        if len(paths) == 1:
            recording.send_blueprint(layout([Shown(labels[0], end_ns=read_end_ns(paths[0]))]))
            rr.send_chunks(_chunks(paths[0], copies[0], labels[0], shares[0]), recording=recording)
        else:
            end_ns = max(map(read_end_ns, paths))
            shown = [
                Shown(label, name, str(rr.new_entity_path([name])), f"{name}/world", end_ns)
                for label, name in zip(labels, names, strict=True)
            ]
            recording.send_blueprint(layout(shown))
            for path, copy, log, progress in zip(paths, copies, shown, shares, strict=True):
                rr.send_chunks(_moved(_chunks(path, copy, log.label, progress), log), recording=recording)
        recording.send_recording_name(title)
        # Read once: each reading ends the file.
        return stream.read() or b""


def _chunks(path: Path, copy: Path, label: Label, progress: Progress) -> Generator[Chunk, None, None]:
    """Yield all shown chunks of a log."""
    collector, end_ns = Collector(), read_end_ns(path)
    for chunk in collector.passing(copy, path):
        yield chunk
        if progress is not None and not chunk.is_static and end_ns:
            progress(min(times_of(chunk.to_record_batch()).max(initial=0) / end_ns, 1.0))
    yield from standing_chunks(label)
    additions = Additions(label, path, max(INTERVAL_NS, end_ns // PICTURES))
    yield from additions.chunks(collector, _few)


def _few(samples: Samples) -> Samples:
    """Return the samples that have a picture."""
    return samples.thinned(max(SAMPLES_PER_PICTURE, len(samples.times_ns) // PICTURES))


class Additions:
    """Chunks that views show in addition to a log's own; the log may come in pieces.

    The interval is the time between two rows of a strip of line images [ns].
    """

    def __init__(self, label: Label, source: Path, interval_ns: int = INTERVAL_NS) -> None:
        self._label, self._source = label, source
        self._bodies = bodies_of(label.attachments, label.robots, source)
        self._rays: Rays | None = None
        self._light: FloorLight | None = None
        self._strips = Strips(interval_ns)
        self._last: dict[str, Floats] = {}
        self._ghost = Ghost(label, source) if is_shadow(label) else None

    def chunks(self, collected: Collector, thinned: Callable[[Samples], Samples]) -> Iterator[Chunk]:
        """Yield those of a piece; `thinned` returns the samples that have a picture."""
        poses = collected.poses()
        yield from event_chunks(self._label, collected, poses, self._last)
        if poses is not None and self._rays is None:
            self._rays, self._light = Rays(self._label, self._source), FloorLight(self._label, self._source)
        for robot in self._label.robots:
            if (images := collected.images(robot)) is not None:
                yield from self._strips.chunks(robot, *images)
            if (samples := collected.samples(robot)) is not None:
                few = thinned(samples)
                yield from panel_chunks(robot, few, self._bodies[robot])
                if poses is not None and self._rays is not None:
                    yield from self._rays.chunks(robot, few, poses)
                    if few.more:
                        yield from arena_chunks(robot, few, self._rays.leds(robot))
            if poses is not None and (own := poses.bodies.get(f"{robot}/base")) is not None:
                before = self._last.get(robot)
                yield from path_chunks(trail(robot), poses.times_ns, own[:, :3], TRAIL, before)
                self._last[robot] = own[-1]
        if self._light is not None:
            yield from self._light.chunks(collected)
        if self._ghost is not None:
            yield from self._ghost.chunks(collected)


def _moved(chunks: Iterable[Chunk], log: Shown) -> Generator[Chunk, None, None]:
    """Yield the chunks of a log below its path, with its own coordinate frames."""
    for chunk in chunks:
        if chunk.entity_path == "/__mcap_properties":
            continue  # of a recording that is one log
        batch: Any = chunk.to_record_batch()
        for name in set(_FRAMES) & set(batch.schema.names):
            index = batch.schema.get_field_index(name)
            rows = [
                row and [f"{log.name}/{frame}" for frame in row] for row in batch.column(index).to_pylist()
            ]
            field = batch.schema.field(index)
            batch = batch.set_column(index, field, pa.array(rows, field.type))
        for each in Chunk.from_record_batch(batch):
            yield each.with_entity_path(f"{log.place}{chunk.entity_path}")
