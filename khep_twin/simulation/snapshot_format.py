"""Snapshots as bytes: a mark, a version, the fingerprint of the scene, and the state as compressed JSON.

Each part of a simulation has a named tuple for its state, with types and ranges, and these nest. A snapshot
may come from anyone with a log, so pydantic checks all of it; arrays are their bytes, in base64.
"""

import struct
import zlib
from functools import cache
from typing import Any, NamedTuple, TypeVar

from pydantic import TypeAdapter, ValidationError

from khep_twin.errors import SnapshotError

VERSION = 2
"""Version of the format; it rises when a state has other fields."""

_MARK = b"KHEPSNAP"
_HEAD = struct.Struct("<8sH16s")

_LARGEST = 64 << 20
"""Most bytes of an unpacked snapshot that are read."""

_State = TypeVar("_State", bound=NamedTuple)


def pack(state: NamedTuple, scene: str) -> bytes:
    """Return a state of a scene with this fingerprint as bytes."""
    packed = zlib.compress(_adapter(type(state)).dump_json(state), 6)
    return _HEAD.pack(_MARK, VERSION, bytes.fromhex(scene)) + packed


def unpack(data: bytes, kind: type[_State], scene: str | None) -> _State:
    """Return the state of a scene with this fingerprint, or of any scene with None.

    Raises:
        SnapshotError: The bytes are no such snapshot.
    """
    if len(data) < _HEAD.size or data[: len(_MARK)] != _MARK:
        raise SnapshotError(f"{len(data)} bytes that begin with {data[:8].hex() or 'nothing'}: no snapshot")
    _, version, found = _HEAD.unpack_from(data)
    if version != VERSION:
        raise SnapshotError(key="version of the snapshot", value=version, expected=str(VERSION))
    if scene is not None and found.hex() != scene:
        raise SnapshotError(
            f"the snapshot is of another scene, {found.hex()}; expected {scene}, this world's"
        )
    inflater = zlib.decompressobj()
    try:
        text = inflater.decompress(data[_HEAD.size :], _LARGEST)
    except zlib.error as error:
        raise SnapshotError(f"the snapshot cannot be unpacked: {error}") from None
    if not inflater.eof:
        raise SnapshotError(f"the snapshot is torn, or larger than {_LARGEST >> 20} MiB")
    try:
        return _adapter(kind).validate_json(text, strict=True)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        place = ".".join(map(str, first["loc"]))
        given = repr(first["input"])[:40]
        raise SnapshotError(f"snapshot: {place} = {given}: {first['msg']}") from None


@cache
def _adapter(kind: type[_State]) -> TypeAdapter[Any]:
    return TypeAdapter(kind)
