"""Golden transcripts: the bytes on the line, word for word, on every kind of port."""

import re
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import parse_qsl, urlsplit

import pytest
import serial
from served_twin import served

import khep_twin  # noqa: F401  (teaches pyserial khep://)

TRANSCRIPTS = sorted((Path(__file__).parent / "data" / "transcripts").glob("*.txt"))
BAUD_RATES = {"1": 9600, "8": 57600}


def url_of(transcript: Path) -> str:
    return transcript.read_text().splitlines()[0].removeprefix("# ")


def speed_of(url: str) -> int:
    return BAUD_RATES[dict(parse_qsl(urlsplit(url).query)).get("mode", "1")]


@contextmanager
def in_process(url: str) -> Iterator[Any]:
    with serial.serial_for_url(url, baudrate=speed_of(url), timeout=1) as port:
        yield port


@contextmanager
def behind_a_pty(url: str) -> Iterator[Any]:
    parts = urlsplit(url)
    options = [word for key, value in parse_qsl(parts.query) for word in (f"--{key}", value)]
    with (
        served(parts.netloc, *options) as (_, path),
        serial.Serial(path, speed_of(url), stopbits=2, timeout=1) as port,
    ):
        yield port


def play(transcript: Path, port: Any) -> None:
    wait = getattr(port, "sleep", time.sleep)
    request, deadline = b"", 0.0
    for number, line in enumerate(transcript.read_text().splitlines(), 1):
        kind, _, text = line.partition(" ")
        place = f"{transcript.name}, line {number}: {line}"
        match kind:
            case "#" | "":
                pass
            case ">":
                request = text.encode() + b"\n"
                port.write(request)
            case ">>":
                port.write(text.encode().decode("unicode_escape").encode("latin-1"))
            case "<":
                reply = port.read_until(b"\n")
                pattern = re.escape(text).replace(r"\*", "[^,]*") + "\r\n"
                # On a busy machine a served twin may be behind: what follows a wait is asked again.
                while time.monotonic() < deadline and not re.fullmatch(pattern, reply.decode("ascii")):
                    port.write(request)
                    reply = port.read_until(b"\n")
                assert re.fullmatch(pattern, reply.decode("ascii")), f"{place}: came {reply!r}"
                if text.startswith("serial "):
                    port.baudrate = int(text.removeprefix("serial "))
                deadline = 0.0
            case "~":
                wait(float(text))
                deadline = time.monotonic() + 10.0 if wait is time.sleep else 0.0
            case ".":
                before, port.timeout = port.timeout, float(text)
                assert port.read(1) == b"", place
                port.timeout = before
            case _:
                raise ValueError(place)


CASES = [(in_process, transcript) for transcript in TRANSCRIPTS]
LONG_CASES = [
    pytest.param(behind_a_pty, transcript, marks=pytest.mark.long) for transcript in TRANSCRIPTS[1::2]
]


@pytest.mark.parametrize(
    ("way_in", "transcript"),
    [*CASES, *((behind_a_pty, transcript) for transcript in TRANSCRIPTS[::2]), *LONG_CASES],
    ids=lambda parameter: getattr(parameter, "stem", "") or parameter.__name__,
)
def test_what_is_said_is_what_is_written(transcript: Path, way_in: Any) -> None:
    with way_in(url_of(transcript)) as port:
        play(transcript, port)


def test_there_are_transcripts_of_every_command_and_error() -> None:
    sent = {
        line[2:].split(",")[0].split()[0]
        for transcript in TRANSCRIPTS
        for line in transcript.read_text().splitlines()
        if line.startswith("> ")
    }
    assert set("ABCDEFGHIJKLNOPRTW") <= sent
    assert {"restart", "serial", "net", "run", "sfill"} <= sent
