"""Foxglove's published definition of SceneUpdate, from the package foxglove-schemas-protobuf.

    python -m tools foxglove-schema [FILE]

writes it, with its dependencies, as a google.protobuf.FileDescriptorSet.
"""

from pathlib import Path

from foxglove_schemas_protobuf.SceneUpdate_pb2 import SceneUpdate
from google.protobuf.descriptor import FileDescriptor
from google.protobuf.descriptor_pb2 import FileDescriptorSet

from tools.command_table import command_line


def published() -> FileDescriptorSet:
    """Return the definition; the dependencies of a file stand before it."""
    definition = FileDescriptorSet()

    def add(file: FileDescriptor) -> None:
        if file.name not in {entry.name for entry in definition.file}:
            for part in file.dependencies:
                add(part)
            file.CopyToProto(definition.file.add())

    add(SceneUpdate.DESCRIPTOR.file)
    return definition


def main() -> None:
    """Write the definition into a file."""
    parser = command_line(__doc__)
    parser.add_argument("file", nargs="?", type=Path, default="khep_twin/assets/foxglove_scene_update.bin")
    parser.parse_args().file.write_bytes(published().SerializeToString(deterministic=True))
