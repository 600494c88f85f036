"""Series in packed form, read as the page reads them."""

import json
import struct
import zlib

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from khep_twin.web.packing import TIME_UNIT_NS, Series, pack, thin


def unpack(data: bytes) -> tuple[dict[str, object], dict[str, tuple[list[int], list[list[int]]]]]:
    """Return header and series of a package: times in its unit, and columns."""
    content = zlib.decompress(data)
    (length,) = struct.unpack_from("<I", content)
    header = json.loads(content[4 : 4 + length])
    offset, series = 4 + length, {}

    def read(width: int, n: int, kind: str) -> np.ndarray:
        nonlocal offset
        planes = np.frombuffer(content, np.uint8, n * width, offset).reshape(width, n)
        offset += n * width
        steps = np.ascontiguousarray(planes.T).view(f"<{kind}{width}").ravel()
        return np.cumsum(steps, dtype=np.int64 if kind == "u" else steps.dtype)

    for item in header["series"]:
        times = read(4, item["n"], "u").tolist()
        series[item["name"]] = times, [read(width, item["n"], "i").tolist() for width in item["widths"]]
    assert offset == len(content)
    return header, series


@settings(max_examples=40, deadline=None)
@given(arrays(np.int64, (5, 3), elements=st.integers(-(2**31) + 1, 2**31 - 1)))
def test_all_integers_of_32_bits_are_unpacked_as_they_were(values: np.ndarray) -> None:
    times_ns = np.array([0, 20, 40, 41, 3_600_000]) * 1_000_000
    header, series = unpack(pack({"name": "</script>"}, {"a": Series(times_ns, values.astype(float))}))
    times, columns = series["a"]
    assert header["name"] == "</script>"
    assert times == (times_ns // TIME_UNIT_NS).tolist()
    assert columns == values.T.tolist()


def test_thinning_keeps_the_sample_at_or_before_each_mark_and_the_last_one() -> None:
    times_ns = np.arange(0, 200, 20)
    assert thin(times_ns, 0, ()).tolist() == list(range(10))
    assert thin(times_ns, 100, ()).tolist() == [0, 5, 9]
    assert thin(times_ns, 100, (0, 65, 120)).tolist() == [0, 3, 5, 6, 9]
    assert thin(times_ns[:0], 100, (5,)).tolist() == []
