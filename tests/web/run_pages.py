"""Logs for pages, and what their pages contain."""

import json
import re
import zlib
from base64 import b64decode
from pathlib import Path
from typing import Any

from log_rewriting import rewritten

from khep_twin.log.channels import Level, TextLine, line_message
from khep_twin.ports.twin import TwinOptions, open_twin

HOSTILE = "</script><img src=x onerror=alert(1)><script>alert(2)</script><!--"
"""Text that would run a script if it were markup."""


def record(path: Path, seconds: float, playpen: str = "obstacles", commands: tuple[bytes, ...] = ()) -> Path:
    """Write the log of a robot that drives ahead, and asks for its readings; return its path."""
    with open_twin(playpen, TwinOptions(seed=3, log=str(path))) as twin:
        for command in (b"D,20,20\n", *commands):
            for robot in twin.robots:
                robot.send(command)
            twin.advance_to(twin.world.time_ns + 100_000_000)
        twin.advance_to(round(seconds * 1e9))
    return path


def with_hostile_texts(log: Path, target: Path) -> Path:
    """Write a copy of a log whose texts are markup; return its path."""

    def change(topic: str, time_ns: int, data: bytes) -> bytes:
        if topic != "/events" and not topic.endswith("/serial"):
            return data
        return line_message(TextLine(time_ns, Level.INFO, HOSTILE, HOSTILE))

    facts = {"controller": HOSTILE, "seed": HOSTILE}
    return rewritten(log, target, message=change, facts=facts)


def headers(html: str) -> list[dict[str, Any]]:
    """Return the header of each run in a page."""
    packed = re.findall(r'class="packed"[^>]*>([^<]*)</script>', html)
    contents = [zlib.decompress(b64decode(text)) for text in packed]
    return [json.loads(data[4 : 4 + int.from_bytes(data[:4], "little")]) for data in contents]
