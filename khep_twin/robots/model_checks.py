"""Checks of a model of robot: of its data when it is loaded, of its code before its conformance checks."""

from collections.abc import Iterable, Iterator
from importlib.metadata import EntryPoint
from typing import NamedTuple, cast

from khep_twin.errors import RobotModelError, value_text
from khep_twin.robots.body import PER_METRE, Body
from khep_twin.robots.model import GROUP, Dialect, Interface, RobotModel, Term


class _Rule(NamedTuple):
    """Requirement of a field: whether it is met, the field, its value and the expected one."""

    is_met: bool
    field: str
    value: object
    expected: str


def check_model(model: RobotModel) -> None:
    """Check that the fields of a model agree, without an import of its parts.

    Raises:
        RobotModelError: A field is wrong, or of another type.
    """
    try:
        _check(model, _rules(model))
    except (AttributeError, LookupError, TypeError, ValueError) as error:
        raise RobotModelError(f"model {model.name}: {type(error).__name__}: {error}") from error


def check_identity(model: RobotModel, host_class: type, reply: str | None) -> None:
    """Check the fields of a model about its host class, and about the reply to the first probe.

    Args:
        model: Model.
        host_class: Its part "host".
        reply: Reply of its twin; None if it is unknown.

    Raises:
        RobotModelError: They are of another class or reply.
    """
    dialect = model.dialect
    module, _, attribute = dialect.host_class.rpartition(".")
    try:
        named_class: object = EntryPoint("host_class", f"{module}:{attribute}", GROUP).load()
    except (ImportError, AttributeError, ValueError):
        named_class = None
    path = f"{host_class.__module__}.{host_class.__qualname__}"
    pattern = dialect.versions_reply
    expected_pattern = f"a pattern of the whole reply to {dialect.probes[0]!r}, {reply!r}"
    rules = (
        _Rule(named_class is host_class, "dialect.host_class", dialect.host_class, path),
        _Rule(
            reply is None or pattern.fullmatch(reply) is not None,
            "dialect.versions_reply",
            pattern.pattern,
            expected_pattern,
        ),
    )
    _check(model, rules)


def _check(model: RobotModel, rules: Iterable[_Rule]) -> None:
    """Raise an error for the first rule that is not met."""
    for is_met, field, value, expected in rules:
        if not is_met:
            raise RobotModelError(f"model {model.name}: {field} = {value_text(value)}; expected {expected}")


def _rules(model: RobotModel) -> Iterator[_Rule]:
    yield from _body_rules(model.body)
    yield from _channel_rules(model)
    yield from _dialect_rules(model.dialect, model.parts["host"])
    yield _Rule(len(model.roms) > 0, "roms", model.roms, "one version of firmware or more")
    if model.interface is not None:
        n_registers = len(model.channels.get("registers", ()))
        yield from _interface_rules(model.interface, n_registers, len(model.body.sensors))
        for term in model.terms:
            yield from _term_rules(term, model.interface.n_registers)


def _body_rules(body: Body) -> Iterator[_Rule]:
    n_sensors = len(body.sensor_positions) + len(body.ground_positions)
    names = f"a tuple of {n_sensors} names, one for each of sensor_positions and ground_positions"
    yield _Rule(_is_tuple(body.sensors, n_sensors), "body.sensors", body.sensors, names)
    lengths = "radius", "height", "wheel_radius", "wheel_width", "wheel_base"
    ground = ("ground_height",) if body.ground_positions else ()
    for name in ("mass", "pulses_per_turn", *lengths, *ground):
        yield _Rule(getattr(body, name) > 0, f"body.{name}", getattr(body, name), "a number above 0")
    if (sonar := body.sonar) is not None:
        n_sonars = f"a tuple of {len(sonar.headings_deg)} names, one for each of headings_deg"
        is_named = _is_tuple(sonar.names, len(sonar.headings_deg))
        yield _Rule(is_named, "body.sonar.names", sonar.names, n_sonars)
        n_positions = (
            f"a tuple of {len(sonar.headings_deg)} positions, one for each of headings_deg, or an empty one"
        )
        is_placed = _is_tuple(sonar.positions, len(sonar.headings_deg)) or sonar.positions == ()
        yield _Rule(is_placed, "body.sonar.positions", sonar.positions, n_positions)
        yield _Rule(_is_tuple(sonar.codes), "body.sonar.codes", sonar.codes, "a tuple of readings")


def _channel_rules(model: RobotModel) -> Iterator[_Rule]:
    channels, body = model.channels, model.body
    sensors = {"proximity": body.sensors, "ambient": body.sensors}
    if body.sonar is not None:
        sensors["ultrasonic"] = body.sonar.names
    leds = ("leds",) if model.rgb_leds else ()
    for name in (*sensors, "speed", "position", *leds, *model.plots):
        yield _Rule(name in channels, "channels", [*channels], f"a channel {name!r} among them")
    for name, names in sensors.items():
        columns = f"{len(names)} columns, one for each of {', '.join(names)}"
        is_complete = len(channels[name]) == len(names)
        yield _Rule(is_complete, f"channels[{name!r}]", [column for column, _ in channels[name]], columns)
    for _, unit in channels["ultrasonic"] if body.sonar is not None else ():
        yield _Rule(unit in PER_METRE, "channels['ultrasonic']: unit", unit, " or ".join(PER_METRE))
    for name in leds:
        size, text = len(channels[name]), f"{3 * len(model.rgb_leds)}, three for each of rgb_leds"
        yield _Rule(size == 3 * len(model.rgb_leds), f"channels[{name!r}]: number of columns", size, text)
    for name in ("speed", "position"):
        columns = [column for column, _ in channels[name]]
        yield _Rule(len(columns) > 1, f"channels[{name!r}]", columns, "left and right first")
    for name, named_columns in channels.items():
        for column, unit in named_columns if name != "registers" else ():
            is_unit = unit != "" and "[" not in unit and "]" not in unit
            label = 'one in brackets at the end of the label, e.g. "left, right [mm/s]"'
            yield _Rule(is_unit, f"channels[{name!r}]: unit of {column}", unit, label)


def _dialect_rules(dialect: Dialect, host: str) -> Iterator[_Rule]:
    for name in ("probes", "stop_requests"):
        requests = getattr(dialect, name)
        yield _Rule(
            _is_tuple(requests) and len(requests) > 0, f"dialect.{name}", requests, "a tuple of requests"
        )
        for request in requests:
            yield _Rule(
                _is_request(dialect, request),
                f"dialect.{name}",
                request,
                "the text of a request of its framing",
            )
    yield _Rule(_is_tuple(dialect.moving), "dialect.moving", dialect.moving, "a tuple of prefixes")
    _, _, class_name = host.partition(":")
    is_host = dialect.host_class.rpartition(".")[2] == class_name
    yield _Rule(
        is_host,
        "dialect.host_class",
        dialect.host_class,
        f"a path that ends in .{class_name}, the class of the part host",
    )


def _interface_rules(interface: Interface, n_columns: int, n_sensors: int) -> Iterator[_Rule]:
    n_registers = interface.n_registers
    at_least = f"{n_columns} or more, the number of registers in the channels"
    yield _Rule(n_registers >= n_columns, "interface.n_registers", n_registers, at_least)
    for name in ("proximity", "ambient"):
        first, end = getattr(interface, name)
        is_range = 0 <= first < end <= min(n_registers, first + n_sensors)
        text = f"the first register and the end of at most {n_sensors} sensors, within 0 to {n_registers}"
        yield _Rule(is_range, f"interface.{name}", (first, end), text)
    ranges = {"sides": interface.proximity, "setpoints": (0, n_registers), "positions": (0, n_registers)}
    for name, (first, end) in ranges.items():
        pair = getattr(interface, name)
        is_pair = _is_tuple(pair, 2) and all(register in range(first, end) for register in pair)
        yield _Rule(is_pair, f"interface.{name}", pair, f"two registers from {first} to {end - 1}")
    low, high = interface.counts
    yield _Rule(low < high, "interface.counts", interface.counts, "the lower one first")
    for name in ("top_speed", "speed_limit", "speed_per_pulse"):
        value = getattr(interface, name)
        yield _Rule(value > 0, f"interface.{name}", value, "a number above 0")


def _term_rules(term: Term, n_registers: int) -> Iterator[_Rule]:
    field = f"term {term.name}"
    yield _Rule(
        _is_tuple(term.names) and len(term.names) > 0, f"{field}: names", term.names, "a tuple of names"
    )
    last = n_registers - len(term.names)
    text = f"0 to {last}, as {len(term.names)} of {n_registers} registers follow"
    yield _Rule(0 <= term.register <= last, f"{field}: register", term.register, text)
    yield _Rule(term.low < term.high, f"{field}: low", term.low, f"a number below high = {term.high}")


def _is_tuple(value: object, size: int | None = None) -> bool:
    """Return whether a value is a tuple, of this size, not the text that a missing comma leaves."""
    return isinstance(value, tuple) and size in (None, len(cast(tuple[object, ...], value)))


def _is_request(dialect: Dialect, text: str) -> bool:
    try:
        return bool(dialect.framing.encode(text))
    except ValueError:
        return False
