"""Message types of ROS 2 that logs and nodes use: one table of definitions, and their hashes.

The definitions are those of the packages of the same names in ROS 2 Jazzy, and of foxglove_msgs 3.2, without
their comments. A name without "/" is a basic type. `SCHEMAS` are complete texts of a `ros2msg` schema.
"""

import hashlib
import json
import re
from collections.abc import Mapping
from functools import cache
from typing import Any, NamedTuple

Message = Mapping[str, Any]
"""Fields of a message by name; a nested message is a mapping, and a time an integer [ns]."""

MessageFields = dict[str, Any]
"""Fields of a message that is being made."""

_ARRAY = "std_msgs/MultiArrayLayout layout\n{}[] data"
_XYZ = "float64 x\nfloat64 y\nfloat64 z"
_SHAPE = "geometry_msgs/Pose pose\ngeometry_msgs/Vector3 size\n"
_COLOURS = (
    "geometry_msgs/Point[] points\nfoxglove_msgs/Color color\nfoxglove_msgs/Color[] colors\nuint32[] indices"
)
_OUTCOME = "bool success\nstring message"

_FIELDS = {
    "builtin_interfaces/Duration": "int32 sec\nuint32 nanosec",
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec",
    "foxglove_msgs/ArrowPrimitive": "geometry_msgs/Pose pose\nfloat64 shaft_length\nfloat64 shaft_diameter\n"
    "float64 head_length\nfloat64 head_diameter\nfoxglove_msgs/Color color",
    "foxglove_msgs/Color": "float64 r\nfloat64 g\nfloat64 b\nfloat64 a",
    "foxglove_msgs/CubePrimitive": f"{_SHAPE}foxglove_msgs/Color color",
    "foxglove_msgs/CylinderPrimitive": f"{_SHAPE}float64 bottom_scale\nfloat64 top_scale\n"
    "foxglove_msgs/Color color",
    "foxglove_msgs/KeyValuePair": "string key\nstring value",
    "foxglove_msgs/LinePrimitive": "uint8 LINE_STRIP=0\nuint8 LINE_LOOP=1\nuint8 LINE_LIST=2\nuint8 type\n"
    f"geometry_msgs/Pose pose\nfloat64 thickness\nbool scale_invariant\n{_COLOURS}",
    "foxglove_msgs/ModelPrimitive": "geometry_msgs/Pose pose\ngeometry_msgs/Vector3 scale\n"
    "foxglove_msgs/Color color\nbool override_color\nstring url\nstring media_type\nuint8[] data",
    "foxglove_msgs/SceneEntity": "builtin_interfaces/Time timestamp\nstring frame_id\nstring id\n"
    "builtin_interfaces/Duration lifetime\nbool frame_locked\nfoxglove_msgs/KeyValuePair[] metadata\n"
    "foxglove_msgs/ArrowPrimitive[] arrows\nfoxglove_msgs/CubePrimitive[] cubes\n"
    "foxglove_msgs/SpherePrimitive[] spheres\nfoxglove_msgs/CylinderPrimitive[] cylinders\n"
    "foxglove_msgs/LinePrimitive[] lines\nfoxglove_msgs/TriangleListPrimitive[] triangles\n"
    "foxglove_msgs/TextPrimitive[] texts\nfoxglove_msgs/ModelPrimitive[] models",
    "foxglove_msgs/SceneEntityDeletion": "builtin_interfaces/Time timestamp\nuint8 MATCHING_ID=0\n"
    "uint8 ALL=1\nuint8 type\nstring id",
    "foxglove_msgs/SceneUpdate": "foxglove_msgs/SceneEntityDeletion[] deletions\n"
    "foxglove_msgs/SceneEntity[] entities",
    "foxglove_msgs/SpherePrimitive": f"{_SHAPE}foxglove_msgs/Color color",
    "foxglove_msgs/TextPrimitive": "geometry_msgs/Pose pose\nbool billboard\nfloat64 font_size\n"
    "bool scale_invariant\nfoxglove_msgs/Color color\nstring text",
    "foxglove_msgs/TriangleListPrimitive": f"geometry_msgs/Pose pose\n{_COLOURS}",
    "geometry_msgs/Point": _XYZ,
    "geometry_msgs/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation",
    "geometry_msgs/PoseStamped": "std_msgs/Header header\ngeometry_msgs/Pose pose",
    "geometry_msgs/PoseWithCovariance": "geometry_msgs/Pose pose\nfloat64[36] covariance",
    "geometry_msgs/PoseWithCovarianceStamped": "std_msgs/Header header\n"
    "geometry_msgs/PoseWithCovariance pose",
    "geometry_msgs/Quaternion": f"{_XYZ}\nfloat64 w",
    "geometry_msgs/Transform": "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation",
    "geometry_msgs/TransformStamped": "std_msgs/Header header\nstring child_frame_id\n"
    "geometry_msgs/Transform transform",
    "geometry_msgs/Twist": "geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular",
    "geometry_msgs/TwistStamped": "std_msgs/Header header\ngeometry_msgs/Twist twist",
    "geometry_msgs/TwistWithCovariance": "geometry_msgs/Twist twist\nfloat64[36] covariance",
    "geometry_msgs/Vector3": _XYZ,
    "nav_msgs/Odometry": "std_msgs/Header header\nstring child_frame_id\n"
    "geometry_msgs/PoseWithCovariance pose\ngeometry_msgs/TwistWithCovariance twist",
    "rcl_interfaces/Log": "byte DEBUG=10\nbyte INFO=20\nbyte WARN=30\nbyte ERROR=40\nbyte FATAL=50\n"
    "builtin_interfaces/Time stamp\nuint8 level\nstring name\nstring msg\nstring file\nstring function\n"
    "uint32 line",
    "rosgraph_msgs/Clock": "builtin_interfaces/Time clock",
    "sensor_msgs/BatteryState": "std_msgs/Header header\nfloat32 voltage\nfloat32 temperature\n"
    "float32 current\nfloat32 charge\nfloat32 capacity\nfloat32 design_capacity\nfloat32 percentage\n"
    "uint8 power_supply_status\nuint8 power_supply_health\nuint8 power_supply_technology\nbool present\n"
    "float32[] cell_voltage\nfloat32[] cell_temperature\nstring location\nstring serial_number",
    "sensor_msgs/Illuminance": "std_msgs/Header header\nfloat64 illuminance\nfloat64 variance",
    "sensor_msgs/Image": "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\n"
    "uint8 is_bigendian\nuint32 step\nuint8[] data",
    "sensor_msgs/Imu": "std_msgs/Header header\ngeometry_msgs/Quaternion orientation\n"
    "float64[9] orientation_covariance\ngeometry_msgs/Vector3 angular_velocity\n"
    "float64[9] angular_velocity_covariance\ngeometry_msgs/Vector3 linear_acceleration\n"
    "float64[9] linear_acceleration_covariance",
    "sensor_msgs/JointState": "std_msgs/Header header\nstring[] name\nfloat64[] position\n"
    "float64[] velocity\nfloat64[] effort",
    "sensor_msgs/LaserScan": "std_msgs/Header header\nfloat32 angle_min\nfloat32 angle_max\n"
    "float32 angle_increment\nfloat32 time_increment\nfloat32 scan_time\nfloat32 range_min\n"
    "float32 range_max\nfloat32[] ranges\nfloat32[] intensities",
    "sensor_msgs/Range": "uint8 ULTRASOUND=0\nuint8 INFRARED=1\nstd_msgs/Header header\n"
    "uint8 radiation_type\nfloat32 field_of_view\nfloat32 min_range\nfloat32 max_range\nfloat32 range\n"
    "float32 variance",
    "service_msgs/ServiceEventInfo": "uint8 event_type\nbuiltin_interfaces/Time stamp\n"
    "uint8[16] client_gid\nint64 sequence_number",
    "std_msgs/Bool": "bool data",
    "std_msgs/Float64MultiArray": _ARRAY.format("float64"),
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id",
    "std_msgs/Int64MultiArray": _ARRAY.format("int64"),
    "std_msgs/MultiArrayDimension": "string label\nuint32 size\nuint32 stride",
    "std_msgs/MultiArrayLayout": "std_msgs/MultiArrayDimension[] dim\nuint32 data_offset",
    "std_msgs/String": "string data",
    "std_msgs/UInt8MultiArray": _ARRAY.format("uint8"),
    "std_srvs/srv/SetBool_Request": "bool data",
    "std_srvs/srv/SetBool_Response": _OUTCOME,
    "std_srvs/srv/Trigger_Request": "",
    "std_srvs/srv/Trigger_Response": _OUTCOME,
    "tf2_msgs/TFMessage": "geometry_msgs/TransformStamped[] transforms",
}
"""Fields of each message type."""

TIMES = "builtin_interfaces/Time", "builtin_interfaces/Duration"
"""Message types that are an integer [ns] in a `Message`."""

TYPE_NUMBERS = {
    name: number
    for number, name in enumerate(
        "int8 uint8 int16 uint16 int32 uint32 int64 uint64 float32 float64".split(), start=2
    )
} | {"bool": 15, "byte": 16, "string": 17}
"""Numbers of the basic types in type descriptions (type_description_interfaces/FieldType)."""


class Field(NamedTuple):
    """Field of a message.

    Attributes:
        name: Name.
        type_name: Basic type, or name of a message type as a key of the table.
        length: Number of values of an array, -1 for a sequence, or None for one value.
        capacity: Largest length of a bounded sequence; 0 without a bound.
    """

    name: str
    type_name: str
    length: int | None = None
    capacity: int = 0

    @property
    def is_basic(self) -> bool:
        """True for numbers and text, false for a nested message."""
        return "/" not in self.type_name


@cache
def fields_of(type_name: str) -> tuple[Field, ...]:
    """Return the fields of a message type, e.g. "nav_msgs/msg/Odometry"; an empty one has a placeholder.

    Raises:
        KeyError: The table lacks the type.
    """
    lines = _FIELDS[_key(type_name)].splitlines() or ["uint8 structure_needs_at_least_one_member"]
    return tuple(_parse(line) for line in lines if "=" not in line)


@cache
def type_hash(type_name: str) -> str:
    """Return the hash of a message type, or of a service like "std_srvs/srv/Trigger" (REP 2016)."""
    described: dict[str, dict[str, object]] = {}

    def describe(name: str, fields: tuple[Field, ...]) -> None:
        described[name] = {"type_name": name, "fields": [_describe_field(field) for field in fields]}
        for field in fields:
            if not field.is_basic and (nested := _full_name(field.type_name)) not in described:
                describe(nested, _service_fields(nested) or fields_of(field.type_name))

    name = _full_name(type_name)
    describe(name, _service_fields(name) or fields_of(type_name))
    description = described.pop(name)
    references = [described[reference] for reference in sorted(described)]
    text = json.dumps({"type_description": description, "referenced_type_descriptions": references})
    return f"RIHS01_{hashlib.sha256(text.encode()).hexdigest()}"


def _service_fields(name: str) -> tuple[Field, ...]:
    """Return the fields of a service's description, or of its events; nothing for a message."""
    service = name.removesuffix("_Event")
    if "/srv/" not in name or name.endswith(("_Request", "_Response")):
        return ()
    if service == name:
        parts = "request", "response", "event"
        return tuple(Field(f"{part}_message", f"{name}_{part.capitalize()}") for part in parts)
    info = Field("info", "service_msgs/ServiceEventInfo")
    return info, *(Field(part, f"{service}_{part.capitalize()}", -1, 1) for part in ("request", "response"))


def _describe_field(field: Field) -> dict[str, object]:
    number = TYPE_NUMBERS[field.type_name] if field.is_basic else 1
    if field.length is not None:
        number += 48 if field.length >= 0 else 96 if field.capacity else 144
    nested = "" if field.is_basic else _full_name(field.type_name)
    capacity = field.capacity or max(field.length or 0, 0)
    type_description = {
        "type_id": number,
        "capacity": capacity,
        "string_capacity": 0,
        "nested_type_name": nested,
    }
    return {"name": field.name, "type": type_description}


def _parse(line: str) -> Field:
    """Return the field of a line of a definition."""
    type_text, name = line.split()
    type_name, brackets, length = re.fullmatch(r"([\w/]+)(\[(\d*)\])?", type_text).groups()  # type: ignore[union-attr]
    return Field(name, type_name, int(length or -1) if brackets else None)


def _key(type_name: str) -> str:
    """Return a type's key in the table."""
    return type_name.replace("/msg/", "/")


def _full_name(type_name: str) -> str:
    """Return a type's name with its kind, e.g. "std_msgs/msg/Header"."""
    return type_name if type_name.count("/") == 2 else type_name.replace("/", "/msg/")


def _definition(type_name: str) -> str:
    """Return the definition of a type: its fields, then those of each type in them."""
    names: dict[str, None] = {}

    def add(name: str) -> None:
        if name not in names:
            names[name] = None
            for field in fields_of(name):
                if not field.is_basic:
                    add(field.type_name)

    add(type_name)
    first, *nested = names
    return "\n".join([_FIELDS[first], *(f"{'=' * 80}\nMSG: {name}\n{_FIELDS[name]}" for name in nested)])


SCHEMAS = {_full_name(name): _definition(name) for name in _FIELDS if "/srv/" not in name}
"""Definition of each message type, as text of a `ros2msg` schema."""
