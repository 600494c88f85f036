"""The messages of a log, decoded here by the rules of CDR, and their readers."""

import struct
from dataclasses import dataclass

import numpy as np
import pytest

from khep_twin.log import channels, decoding
from khep_twin.log.channels import ArrayFrame, ImageFrame, Level, TextLine, TransformFrame


@dataclass
class Cdr:
    """Values of a little-endian CDR message, each at a multiple of its size after the header."""

    message: bytes
    place: int = 4

    def take(self, kind: str) -> float:
        """A number, `kind` as in `struct`."""
        size = struct.calcsize(kind)
        while (self.place - 4) % size:
            assert self.message[self.place] == 0
            self.place += 1
        self.place += size
        return struct.unpack(f"<{kind}", self.message[self.place - size : self.place])[0]

    def string(self) -> str:
        """A length, then text that ends in a zero."""
        length = int(self.take("I"))
        text = self.message[self.place : self.place + length]
        self.place += length
        assert text[-1:] == b"\0"
        return text[:-1].decode()

    def at_end(self) -> bool:
        """Return whether all bytes are read."""
        return self.place == len(self.message)


def rows(messages: np.ndarray) -> list[bytes]:
    """Messages of one size, one by one."""
    data, size = messages.tobytes(), messages.itemsize
    return [data[place : place + size] for place in range(0, len(data), size)]


@pytest.mark.parametrize("label", ["", "a", "abc", "counts", "speed [pulses/10 ms]"])
@pytest.mark.parametrize(("kind", "code"), [("f8", "d"), ("i8", "q")])
def test_an_array_decodes_by_the_rules_of_cdr(label: str, kind: str, code: str) -> None:
    first, second = rows(ArrayFrame(3, kind, label).messages(np.array([[1, -2, 1023], [4, 5, 6]])))
    assert len(first) == len(second)
    for message, values in ((first, [1, -2, 1023]), (second, [4, 5, 6])):
        cdr = Cdr(message)
        assert message[:4] == b"\x00\x01\x00\x00"
        assert (cdr.take("I"), cdr.string(), cdr.take("I"), cdr.take("I")) == (1, label, 3, 3)
        assert (cdr.take("I"), cdr.take("I")) == (0, 3)
        assert [cdr.take(code) for _ in range(3)] == values
        assert cdr.at_end()


def test_transforms_decode_by_the_rules_of_cdr() -> None:
    names = ["khepera0/base", "b", "khepera0/left_wheel"]
    random = np.random.default_rng(0)
    positions, quaternions = random.normal(size=(2, 3, 3)), random.normal(size=(2, 3, 4))
    times_ns = np.array([0, 12_345_678_901])
    poses = np.concatenate([positions, quaternions[:, :, [1, 2, 3, 0]]], axis=2)
    messages = TransformFrame([("map", name) for name in names]).messages(times_ns, poses)
    for row, message in enumerate(rows(messages)):
        cdr = Cdr(message)
        assert cdr.take("I") == 3
        for body, name in enumerate(names):
            seconds, nanoseconds = cdr.take("i"), cdr.take("I")
            assert seconds * 10**9 + nanoseconds == times_ns[row]
            assert (cdr.string(), cdr.string()) == ("map", name)
            assert [cdr.take("d") for _ in range(3)] == positions[row, body].tolist()
            assert [cdr.take("d") for _ in range(4)] == quaternions[row, body, [1, 2, 3, 0]].tolist()
        assert cdr.at_end()


@pytest.mark.parametrize("text", ["", "N", "no", "n,1", "n,12", "D,-5,5"])
@pytest.mark.parametrize("name", ["host", "robot", "x"])
def test_a_line_decodes_by_the_rules_of_cdr(name: str, text: str) -> None:
    cdr = Cdr(channels.line_message(TextLine(2_000_000_007, Level.WARN, name, text)))
    assert (cdr.take("i"), cdr.take("I"), cdr.take("B")) == (2, 7, 30)
    assert (cdr.string(), cdr.string(), cdr.string(), cdr.string()) == (name, text, "", "")
    assert cdr.take("I") == 0
    assert cdr.at_end()


def test_what_is_encoded_can_be_read_back() -> None:
    line = TextLine(5_000_000_123, Level.INFO, "robot", "n,1,2,3")
    assert decoding.read_line(channels.line_message(line)) == line
    values = [[1.0, 2.5, -3.0]]
    (message,) = rows(ArrayFrame(3, "f8", "x").messages(np.array(values)))
    assert list(decoding.read_array(message, "d")) == values[0]
    pose = np.array([[[1.0, 1, 1, 0, 0, 0, 1]]])
    (message,) = rows(TransformFrame([("map", "a")]).messages(np.zeros(1, np.int64), pose))
    assert decoding.read_transforms(message) == {"a": (1, 1, 1, 0, 0, 0, 1)}


@pytest.mark.parametrize(("kind", "letter"), [("f8", "d"), ("i8", "q")])
def test_many_arrays_are_read_at_once_as_one_by_one(kind: str, letter: str) -> None:
    values = np.arange(12).reshape(4, 3) - 5
    messages = rows(ArrayFrame(3, kind, "counts").messages(values))
    arrays = decoding.stack_arrays(messages, letter)
    assert arrays.dtype == np.dtype(kind)
    assert arrays.tolist() == values.tolist()
    other = rows(ArrayFrame(3, kind, "another label").messages(values))
    assert decoding.stack_arrays(messages + other, letter).tolist() == [*values.tolist(), *values.tolist()]
    with pytest.raises(ValueError, match="2 values; expected 3, as in the channel's first message"):
        decoding.stack_arrays([*messages, *rows(ArrayFrame(2, kind, "").messages(values[:, :2]))], letter)


IMAGES = np.array([[0, 7, 255], [1, 2, 3]])


def test_a_line_image_decodes_by_the_rules_of_cdr() -> None:
    frame = ImageFrame(3, "khepera0/k213")
    messages = rows(frame.messages(np.array([0, 2_500_000_040]), IMAGES))
    for message, time, pixels in zip(messages, ((0, 0), (2, 500_000_040)), IMAGES.tolist(), strict=True):
        cdr = Cdr(message)
        assert (cdr.take("i"), cdr.take("I"), cdr.string()) == (*time, "khepera0/k213")
        assert (cdr.take("I"), cdr.take("I"), cdr.string()) == (1, 3, "mono8")
        assert (cdr.take("B"), cdr.take("I"), cdr.take("I")) == (0, 3, 3)
        assert [cdr.take("B") for _ in range(3)] == pixels
        assert cdr.at_end()
    assert np.array_equal(decoding.stack_images(messages), IMAGES)


@pytest.mark.parametrize(
    ("old", "new", "fault"),
    [
        (b"mono8", b"mono9", "an image of 3 x 1 pixels mono9 in 3 bytes"),
        (b"\1\0\0\0\3\0\0\0", b"\2\0\0\0\3\0\0\0", "an image of 3 x 2 pixels mono8 in 3 bytes"),
        (b"\0\7\xff", b"\0\7", "3 values of 1 bytes"),
        (b"\0\7\xff", b"\0\7\xff\0", "bytes"),
    ],
)
def test_another_image_is_refused(old: bytes, new: bytes, fault: str) -> None:
    messages, second = rows(ImageFrame(3, "khepera0/k213").messages(np.array([0, 1]), IMAGES))
    assert messages.count(old) == 1
    with pytest.raises(decoding.DecodeError, match=fault) as caught:
        decoding.stack_images([second, messages.replace(old, new)])
    assert caught.value.row == 1


def test_images_of_two_widths_are_refused() -> None:
    narrow, wide = (rows(ImageFrame(n, "a").messages(np.array([0]), np.zeros((1, n))))[0] for n in (3, 4))
    with pytest.raises(decoding.DecodeError, match="4 pixels; expected 3, as in the channel's first message"):
        decoding.stack_images([narrow, wide])
