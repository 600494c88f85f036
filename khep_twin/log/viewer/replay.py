"""View of finished logs in rerun: arena, curves and transcript on one time axis, several logs side by side.

rerun reads logs without this module, which adds a layout for this robot, and time as seconds of the run
instead of dates in 1970; both are part of a rerun recording, which is saved or shown.
"""

# rerun and pyarrow are not typed, or in part.
# pyright: reportMissingTypeStubs=false
# pyright: reportUnknownMemberType=false, reportUnknownVariableType=false, reportUnknownArgumentType=false

import tempfile
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from typing import Any

import pyarrow as pa
import rerun as rr
from rerun.chunk import Chunk

from khep_twin.clock import NS_PER_S
from khep_twin.errors import LogError
from khep_twin.files.atomic import is_same, part_file
from khep_twin.files.text import escape_surrogates
from khep_twin.log.attached import compile_shapes, playpen_of
from khep_twin.log.channels import MAP
from khep_twin.log.mcap_recovery import Progress, partial_progress
from khep_twin.log.reader import Label, read_end_ns, read_message_batches
from khep_twin.log.robot_models import models_of
from khep_twin.log.run_names import distinct_names
from khep_twin.log.shadow_channels import is_shadow
from khep_twin.log.viewer.arena import (
    TRAIL_COLOUR,
    FloorLight,
    Rays,
    event_chunks,
    old_frame_chunks,
    trail_chunks,
    trail_path,
)
from khep_twin.log.viewer.collected import Collector, Floats, Samples, times_of
from khep_twin.log.viewer.further_sensors import arena_chunks
from khep_twin.log.viewer.ghost import Ghost
from khep_twin.log.viewer.layout import ShownLog, layout
from khep_twin.log.viewer.process import Web, open_viewer, write_still
from khep_twin.log.viewer.robot_panel import (
    ROW_INTERVAL_NS,
    SAMPLES_PER_PICTURE,
    Strips,
    outline_chunks,
    panel_chunks,
)
from khep_twin.log.viewer.thinning import LogCopy, thinning_interval_ns

ProgressBar = Callable[[], AbstractContextManager[Progress]]
"""Function that returns a context in which progress is shown."""

HIDDEN_TOPICS = ["/host_events$", "^/state$", "/registers$", "^/scene$", "^/channel_names$"]
"""Patterns of topics that no view shows: data for programs, or contained in the views."""

PICTURES = 10_000
"""Maximum number of pictures of bars, rays and strips of a run; a longer run has less than ten per second."""

_FRAME_COLUMNS = ("Transform3D:child_frame", "Transform3D:parent_frame", "CoordinateFrame:frame")


def view(
    paths: Sequence[Path],
    save: Path | None = None,
    web: Web | None = None,
    stop: Callable[[], bool] = lambda: False,
    bar: ProgressBar = nullcontext,
    replace: bool = True,
) -> None:
    """Show logs in rerun's viewer until its window is closed, or save them as one rerun recording.

    Args:
        paths: Paths of finished logs, from left to right.
        save: Path of the recording, by convention NAME.rrd; None opens the viewer.
        web: Settings of the viewer in a browser; None opens a window.
        stop: Function called repeatedly that returns whether to stop.
        bar: Function that returns a progress bar, e.g. `cli_progress.progress`.
        replace: True to replace an existing file when the recording is saved.

    Raises:
        LogError: A log cannot be read, the recording cannot be written, or no window opens.
    """
    if save is not None:
        _save(paths, save, bar, replace)
        return
    with _temporary_recording(paths, bar) as recording, open_viewer(str(paths[0]), web, recording) as viewer:
        viewer.wait(stop)


def view_still(
    paths: Sequence[Path],
    target: Path,
    at_s: float | None = None,
    bar: ProgressBar = nullcontext,
    replace: bool = True,
) -> None:
    """Write a PNG still of logs, from left to right, at a simulated time [s], without a screen.

    By default it shows the end, with the complete run; `replace` is as for `write_drawing`.

    Raises:
        LogError: A log cannot be read, or the viewer is not available.
    """
    with _temporary_recording(paths, bar) as recording:
        end_s = max(map(read_end_ns, paths)) / NS_PER_S
        write_still(recording, end_s if at_s is None else at_s, target, replace)


def static_chunks(label: Label) -> list[Chunk]:
    """Return the static chunks to add to those of a log: the outlines of its robots' panels."""
    panels = "playpen.toml" in label.attachments and not is_shadow(label)
    models = models_of(label.attachments, label.robots) if panels else {}
    return [chunk for robot, model in models.items() for chunk in outline_chunks(robot, model)]


def _check_and_copy(path: Path, copy_path: Path, progress: Progress) -> Label:
    """Check a log and copy its shown parts; return its label."""
    label, has_poses = None, False
    with copy_path.open("xb") as file:
        writer = LogCopy(file, thinning_interval_ns(read_end_ns(path)), HIDDEN_TOPICS)
        for recording, messages in read_message_batches(path, progress):
            label = recording.label
            writer.add(messages)
            has_poses |= any(f"/{robot}/pose" in recording.series for robot in label.robots)
        assert label is not None  # there is at least one piece
        writer.finish(label)
    if has_poses or "playpen.toml" in label.attachments:
        playpen_of(label.attachments, path)
    if has_poses:
        compile_shapes(label.attachments, label.robots, path)
    return label


@contextmanager
def _temporary_recording(paths: Sequence[Path], bar: ProgressBar) -> Generator[Path, None, None]:
    """Provide a temporary recording."""
    with tempfile.TemporaryDirectory(prefix="khep-twin-") as folder:
        recording = Path(folder) / f"{escape_surrogates(paths[0].stem)}.rrd"
        _save(paths, recording, bar)
        yield recording


def _save(paths: Sequence[Path], save: Path, bar: ProgressBar, replace: bool = True) -> None:
    if save.is_dir() or any(is_same(save, path) for path in paths):
        kind = "a directory" if save.is_dir() else "the log itself"
        raise LogError(f"{save}: this is {kind}; expected the name of a file, such as {paths[0].stem}.rrd")
    # Each log is read twice: to check and copy it, and by rerun.
    count = 2 * len(paths)
    try:
        with bar() as progress, tempfile.TemporaryDirectory(prefix="khep-twin-") as folder:
            parts = [partial_progress(progress, number, count) for number in range(count)]
            copies = [Path(folder) / f"{number}.mcap" for number in range(len(paths))]
            labels = [_check_and_copy(*row) for row in zip(paths, copies, parts, strict=False)]
            recording = _encode_recording(paths, copies, labels, parts[len(paths) :])
        with part_file(save, replace) as file:
            file.write(recording)
    except OSError as error:
        raise LogError(f"{save}: the recording cannot be written: {error.strerror}") from error


def _encode_recording(
    paths: Sequence[Path], copies: Sequence[Path], labels: Sequence[Label], parts: Sequence[Progress]
) -> bytes:
    """Return the logs and their layout as a rerun file; in memory, as rerun may wait for a full disk."""
    names = distinct_names(paths)
    title = " and ".join(names)
    with rr.RecordingStream("khep_twin", recording_id=title) as recording:
        stream = recording.binary_stream()
        if len(paths) == 1:
            recording.send_blueprint(layout([ShownLog(labels[0], end_ns=read_end_ns(paths[0]))]))
            rr.send_chunks(_chunks(paths[0], copies[0], labels[0], parts[0]), recording=recording)
        else:
            end_ns = max(map(read_end_ns, paths))
            logs = [
                ShownLog(label, name, str(rr.new_entity_path([name])), f"{name}/{MAP}", end_ns)
                for label, name in zip(labels, names, strict=True)
            ]
            recording.send_blueprint(layout(logs))
            for path, copy, log, progress in zip(paths, copies, logs, parts, strict=True):
                rr.send_chunks(_relocate(_chunks(path, copy, log.label, progress), log), recording=recording)
        recording.send_recording_name(title)
        # Read once: each read ends the file.
        return stream.read() or b""


def _chunks(path: Path, copy: Path, label: Label, progress: Progress) -> Generator[Chunk, None, None]:
    """Yield all shown chunks of a log."""
    collector, end_ns = Collector(), read_end_ns(path)
    for chunk in collector.collect(copy, path):
        yield chunk
        if progress is not None and not chunk.is_static and end_ns:
            progress(min(times_of(chunk.to_record_batch()).max(initial=0) / end_ns, 1.0))
    yield from static_chunks(label)
    additions = Additions(label, path, max(ROW_INTERVAL_NS, end_ns // PICTURES))
    yield from additions.chunks(collector, thin=_thin_samples)


def _thin_samples(samples: Samples) -> Samples:
    """Return the samples of which the robot's panel is drawn."""
    return samples.thin(max(SAMPLES_PER_PICTURE, len(samples.times_ns) // PICTURES))


class Additions:
    """Chunks added to those of a log, batch by batch; `interval_ns` is the time per row of line images."""

    def __init__(self, label: Label, source: Path, interval_ns: int = ROW_INTERVAL_NS) -> None:
        self._label = label
        self._source = source
        self._models = models_of(label.attachments, label.robots)
        self._rays: Rays | None = None
        self._light: FloorLight | None = None
        self._strips = Strips(interval_ns)
        self._last_poses: dict[str, Floats] = {}
        self._ghost = Ghost(label, source) if is_shadow(label) else None

    def chunks(self, collector: Collector, thin: Callable[[Samples], Samples]) -> Iterator[Chunk]:
        """Yield the chunks of a batch; `thin` returns those samples of which the robot's panel is drawn."""
        poses = collector.poses()
        if poses is not None and self._rays is None and collector.has_old_frames:
            yield from old_frame_chunks(self._label.robots)
        yield from event_chunks(self._label, collector, poses, self._last_poses)
        if poses is not None and self._rays is None:
            self._rays = Rays(self._label, self._source)
            self._light = FloorLight(self._label, self._source)
        for robot in self._label.robots:
            if (images := collector.images(robot)) is not None:
                yield from self._strips.chunks(robot, *images)
            if (samples := collector.samples(robot)) is not None:
                shown_samples = thin(samples)
                yield from panel_chunks(robot, shown_samples, self._models[robot])
                if poses is not None and self._rays is not None:
                    yield from self._rays.chunks(robot, shown_samples, poses)
                    positions = self._rays.led_positions(robot)
                    yield from arena_chunks(robot, self._models[robot], shown_samples, positions)
            if poses is not None and (base_poses := poses.bodies.get(f"{robot}/base")) is not None:
                previous = self._last_poses.get(robot)
                points = base_poses[:, :3]
                yield from trail_chunks(trail_path(robot), poses.times_ns, points, TRAIL_COLOUR, previous)
                self._last_poses[robot] = base_poses[-1]
        if self._light is not None:
            yield from self._light.chunks(collector)
        if self._ghost is not None:
            yield from self._ghost.chunks(collector)


def _relocate(chunks: Iterable[Chunk], log: ShownLog) -> Generator[Chunk, None, None]:
    """Yield the chunks of a log below its path, with separate coordinate frames."""
    for chunk in chunks:
        if chunk.entity_path == "/__mcap_properties":
            continue  # for a recording of one log
        batch: Any = chunk.to_record_batch()
        for name in set(_FRAME_COLUMNS) & set(batch.schema.names):
            index = batch.schema.get_field_index(name)
            rows = [
                row and [f"{log.name}/{frame}" for frame in row] for row in batch.column(index).to_pylist()
            ]
            field = batch.schema.field(index)
            batch = batch.set_column(index, field, pa.array(rows, field.type))
        for relocated in Chunk.from_record_batch(batch):
            yield relocated.with_entity_path(f"{log.path}{chunk.entity_path}")
