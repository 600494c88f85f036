"""serialx and pyserial-asyncio as hosts of a served twin, on each kind of port."""

import asyncio
from collections.abc import Iterator

import pytest
import serial_asyncio
import serialx
from served_twin import served

KINDS = {"pty": (), "tcp": ("--tcp", ":0"), "rfc2217": ("--rfc2217", ":0")}
"""Options of `khep-twin serve`."""

TIMEOUT_S = 30.0

# One command of each form, and a burst, whose replies come one after the other.
EXCHANGES = [
    (b"B\n", b"b,5.02,5.01\r\n"),
    (b"D,5,-5\n", b"d\r\n"),
    (b"G,1000,-1000\n", b"g\r\n"),
    (b"D,0,0\nB\nL,0,1\n", b"d\r\nb,5.02,5.01\r\nl\r\n"),
]


@pytest.fixture(scope="module", params=KINDS)
def url(request: pytest.FixtureRequest) -> Iterator[str]:
    """Path or URL of each kind of port in turn, at 38400 baud."""
    with served("default", "--noise", "off", "--mode", "3", *KINDS[request.param]) as (_, url):
        yield url


def test_serialx_has_every_reply(url: str) -> None:
    with serialx.serial_for_url(url, baudrate=38400, read_timeout=TIMEOUT_S) as port:
        for sent, replies in EXCHANGES:
            port.write(sent)
            assert port.readexactly(len(replies)) == replies
        port.write(b"N\n")
        assert port.readline().count(b",") == 8


def test_serialx_asyncio_has_every_reply(url: str) -> None:
    async def talk() -> None:
        reader, writer = await serialx.open_serial_connection(url=url, baudrate=38400)
        await _exchange(reader, writer)

    asyncio.run(asyncio.wait_for(talk(), TIMEOUT_S))


def test_pyserial_asyncio_has_every_reply(url: str) -> None:
    if url.startswith("rfc2217:"):
        pytest.skip("pyserial-asyncio sets a write timeout, which pyserial's rfc2217:// refuses")

    async def talk() -> None:
        reader, writer = await serial_asyncio.open_serial_connection(url=url, baudrate=38400)
        await _exchange(reader, writer)

    asyncio.run(asyncio.wait_for(talk(), TIMEOUT_S))


async def _exchange(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    for sent, replies in EXCHANGES:
        writer.write(sent)
        assert await reader.readexactly(len(replies)) == replies
    writer.write(b"N\n")
    assert (await reader.readline()).count(b",") == 8
    writer.close()
    await writer.wait_closed()
