"""Twins behind every kind of port."""

import select
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from khep_twin.host import Khepera

KINDS = {"pty": (), "tcp": ("--tcp", ":0"), "rfc2217": ("--rfc2217", ":0")}
"""Options of `khep-twin serve`."""


@contextmanager
def served(*arguments: str) -> Iterator[tuple["subprocess.Popen[str]", str]]:
    """`khep-twin serve`, and what a host opens."""
    command = [sys.executable, "-m", "khep_twin", "serve", *arguments]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
        try:
            assert process.stdout is not None
            assert select.select([process.stdout], [], [], 30)[0], "nothing was served"
            yield process, process.stdout.readline().strip()
        finally:
            process.kill()


@pytest.fixture(scope="module", params=["khep", *KINDS])
def robot(request: pytest.FixtureRequest) -> Iterator[Khepera]:
    """A robot behind one kind of port after the other, at 38400 baud."""
    if request.param == "khep":
        with Khepera("khep://default?noise=off&mode=3", baudrate=38400) as khepera:
            yield khepera
        return
    with (
        served("default", "--noise", "off", "--mode", "3", *KINDS[request.param]) as (_, url),
        Khepera(url, 2.0, baudrate=38400) as khepera,
    ):
        yield khepera
