"""Foxglove's published definition of SceneUpdate, from the package foxglove-schemas-protobuf.

    python tools/foxglove_schema.py FILE

writes it, with its dependencies, as a google.protobuf.FileDescriptorSet.
"""

import sys
from pathlib import Path

from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.descriptor import FileDescriptor
from google.protobuf.descriptor_pb2 import FileDescriptorSet


def published() -> FileDescriptorSet:
    """Return the definition; the dependencies of a file come before it."""
    found = FileDescriptorSet()

    def add(file: FileDescriptor) -> None:
        if file.name not in {each.name for each in found.file}:
            for part in file.dependencies:
                add(part)
            file.CopyToProto(found.file.add())

    add(SceneUpdate.DESCRIPTOR.file)
    return found


if __name__ == "__main__":
    Path(sys.argv[1]).write_bytes(published().SerializeToString(deterministic=True))
