"""Line images of a robot's turret: from replies on a line into a log, and as a strip in rerun."""

from pathlib import Path

import numpy as np
import pytest

from khep_twin.log.line_recorder import LineRecorder
from khep_twin.log.reader import read_series
from khep_twin.log.viewer.robot_panel import ROW_INTERVAL_NS, ROWS, Strips, strip_path


def test_a_reply_with_an_image_is_an_image_of_the_log(tmp_path: Path) -> None:
    now = [0]
    recorder = LineRecorder(tmp_path / "real.mcap", {"relay": "/dev/robot"}, lambda: now[0])
    pixels = [(7 * pixel) % 256 for pixel in range(64)]
    for time_ns, reply in (
        (10, pixels),
        (20, pixels[:63]),  # a part of it
        (30, [*pixels[:63], 256]),  # no grey
        (40, pixels[::-1]),
    ):
        now[0] = time_ns
        recorder.on_bytes(True, b"T,2,N\n")
        recorder.on_bytes(False, f"t,2,n,{','.join(map(str, reply))}\r\n".encode())
    recorder.close()
    series = read_series(tmp_path / "real.mcap").series["/khepera0/vision"]
    assert series.times_ns.tolist() == [10, 40]
    assert series.values.tolist() == [pixels, pixels[::-1]]


@pytest.mark.parametrize("cut", [1, 30, 249])
def test_a_strip_in_pieces_is_the_whole_one(cut: int) -> None:
    times_ns = np.arange(250) * 20_000_000
    images = np.random.default_rng(1).integers(0, 256, (250, 64)).astype(np.float64)
    first, last = Strips(), Strips()
    chunk = pictures(first, times_ns, images)
    pieces = pictures(last, times_ns[:cut], images[:cut]) + pictures(last, times_ns[cut:], images[cut:])
    assert pieces == chunk
    assert len(chunk) == 250 * 20_000_000 // ROW_INTERVAL_NS
    newest = np.frombuffer(chunk[-1], np.uint8).reshape(ROWS, 64)
    assert np.array_equal(newest[-2:], images[[240, 245]])
    assert np.array_equal(newest[-len(chunk)], images[0])
    assert not newest[: -len(chunk)].any()


def pictures(strips: Strips, times_ns: np.ndarray, images: np.ndarray) -> list[bytes]:
    encoded: list[bytes] = []
    for chunk in strips.chunks("khepera0", times_ns, images):
        assert chunk.entity_path == strip_path("khepera0")
        batch = chunk.to_record_batch()
        buffers = batch.column(batch.schema.get_field_index("Image:buffer"))
        encoded += [bytes(row[0]) for row in buffers.to_pylist()]
    return encoded
