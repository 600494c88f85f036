"""Snapshots as bytes: magic bytes, a version, the fingerprint of the scene, and the state as compressed JSON.

The state consists of nested named tuples, one for each part of a simulation, with types and ranges. A
snapshot may come from an untrusted log, so pydantic validates all of it. Arrays are bytes in base64.
"""

import struct
import zlib
from functools import cache
from typing import Any, NamedTuple, TypeVar

from pydantic import TypeAdapter, ValidationError

from khep_twin.errors import SnapshotError

VERSION = 3
"""Version of the format, incremented when the fields of a state change, except a last one with a default."""

_MAGIC = b"KHEPSNAP"
_HEADER = struct.Struct("<8sH16s")

_MAX_SIZE = 64 << 20
"""Largest accepted size of an unpacked snapshot [bytes]."""

_State = TypeVar("_State", bound=NamedTuple)


def pack(state: NamedTuple, fingerprint: str) -> bytes:
    """Return the snapshot of a state of the scene with this fingerprint."""
    packed = zlib.compress(_adapter(type(state)).dump_json(state), 6)
    return _HEADER.pack(_MAGIC, VERSION, bytes.fromhex(fingerprint)) + packed


def unpack(data: bytes, state_type: type[_State], fingerprint: str | None) -> _State:
    """Return the state in a snapshot of the scene with this fingerprint, or of any scene with None.

    Raises:
        SnapshotError: The bytes are no snapshot of this scene.
    """
    if len(data) < _HEADER.size or data[: len(_MAGIC)] != _MAGIC:
        raise SnapshotError(f"{len(data)} bytes that begin with {data[:8].hex() or 'nothing'}: no snapshot")
    _, version, scene_hash = _HEADER.unpack_from(data)
    if version != VERSION:
        raise SnapshotError(key="version of the snapshot", value=version, expected=str(VERSION))
    if fingerprint is not None and scene_hash.hex() != fingerprint:
        raise SnapshotError(
            f"the snapshot is of another scene, {scene_hash.hex()}; expected {fingerprint}, this world's"
        )
    inflater = zlib.decompressobj()
    try:
        text = inflater.decompress(data[_HEADER.size :], _MAX_SIZE)
    except zlib.error as error:
        raise SnapshotError(f"the snapshot cannot be unpacked: {error}") from None
    if not inflater.eof:
        raise SnapshotError(f"the snapshot is torn, or larger than {_MAX_SIZE >> 20} MiB")
    try:
        return _adapter(state_type).validate_json(text, strict=True)
    except ValidationError as error:
        first_error = error.errors(include_url=False)[0]
        location = ".".join(map(str, first_error["loc"]))
        value = repr(first_error["input"])[:40]
        raise SnapshotError(f"snapshot: {location} = {value}: {first_error['msg']}") from None


@cache
def _adapter(state_type: type[_State]) -> TypeAdapter[Any]:
    return TypeAdapter(state_type)
