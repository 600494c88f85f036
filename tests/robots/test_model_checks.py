"""Checks of a model of robot: its fields when it is loaded, its code and its identity by `conform`."""

import re
from dataclasses import replace
from functools import partial
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import pytest
import serial

from khep_twin import ConstantSpeed, rollout
from khep_twin import playpen as playpens
from khep_twin.cli.ports import _describe_robot  # pyright: ignore[reportPrivateUsage]
from khep_twin.envs.tasks import Task
from khep_twin.errors import CalibrationError, KhepTwinError, RobotModelError
from khep_twin.host import discovery, opening
from khep_twin.lab.conformance.port.conform import conform
from khep_twin.ports.protocol_khep import Serial
from khep_twin.ports.twin import TwinOptions, open_twin
from khep_twin.robots import registry
from khep_twin.robots.body import SonarRing
from khep_twin.robots.framing import LINES
from khep_twin.robots.model import RobotModel, parse_channels
from khep_twin.robots.model_checks import check_identity, check_model
from khep_twin.sensing import calibration
from khep_twin.world import World

pytestmark = pytest.mark.usefixtures("installed_toy")


@pytest.fixture
def toy() -> RobotModel:
    """Model of the Toy."""
    return registry.find_model("toy")


def changed(toy: RobotModel, part: str, **values: Any) -> RobotModel:
    """Return a Toy with other values in a part."""
    if not part:
        return replace(toy, **values)
    new = getattr(toy, part)
    return replace(toy, **{part: replace(new, **values) if part == "body" else new._replace(**values)})


def test_the_shipped_models_and_the_toy_pass_their_checks() -> None:
    for model in registry.installed_models().values():
        check_model(model)


@pytest.mark.parametrize(
    ("part", "values", "message"),
    [
        ("interface", {"sides": (2, 33)}, "interface.sides = (2, 33); expected two registers from 0 to 4"),
        ("interface", {"positions": (15, 17)}, "= (15, 17); expected two registers from 0 to 16"),
        ("interface", {"n_registers": 16}, "interface.n_registers = 16; expected 17 or more"),
        ("interface", {"ambient": (5, 11)}, "interface.ambient = (5, 11); expected the first register and"),
        ("interface", {"counts": (1023, 0)}, "interface.counts = (1023, 0); expected the lower one first"),
        ("interface", {"top_speed": 0}, "interface.top_speed = 0; expected a number above 0"),
        ("body", {"sensors": ("nose",)}, "body.sensors = ('nose',); expected a tuple of 5 names"),
        ("body", {"wheel_radius": 0}, "body.wheel_radius = 0; expected a number above 0"),
        (
            "body",
            {"sensor_positions": ((0.0, 0.0),) * 4, "ground_positions": ((0.0, 0.0),)},
            "body.ground_height = 0.0; expected a number above 0",
        ),
        ("body", {"mass": None}, "TypeError: '>' not supported between instances of 'NoneType' and 'int'"),
        (
            "dialect",
            {"host_class": "toy_robot.host.Toi"},
            "'toy_robot.host.Toi'; expected a path that ends in .Toy",
        ),
        ("dialect", {"stop_requests": "C5"}, "dialect.stop_requests = 'C5'; expected a tuple of requests"),
        (
            "dialect",
            {"probes": ("I",)},
            "dialect.probes = 'I'; expected the text of a request of its framing",
        ),
        (
            "body",
            {"sonar": SonarRing(("beacon",), (20.0,), 0.03, 0.03, (0,), positions=((0.03, 0.01), (0.03, 0)))},
            "body.sonar.positions = ((0.03, 0.01), (0.03, 0)); expected a tuple of 1 positions, one for each",
        ),
        ("", {"roms": {}}, "roms = {}; expected one version of firmware or more"),
        ("", {"plots": {"sonar": "sonar"}}, "expected a channel 'sonar' among them"),
        ("", {"rgb_leds": ("top",)}, "expected a channel 'leds' among them"),
        ("", {"parts": {}}, "KeyError: 'host'"),
    ],
)
def test_a_wrong_field_is_named_with_the_expected_value(
    part: str, values: dict[str, Any], message: str, toy: RobotModel
) -> None:
    with pytest.raises(RobotModelError, match=f"^model toy: .*{re.escape(message)}[^\n]*$"):
        check_model(changed(toy, part, **values))


@pytest.mark.parametrize(
    ("labels", "message"),
    [
        (
            {"speed": None},
            "channels = ['proximity', 'ambient', 'ultrasonic', 'position', 'registers']; expected a",
        ),
        ({"ultrasonic": "beacon [ft]"}, "channels['ultrasonic']: unit = 'ft'; expected m or cm or mm"),
        ({"ultrasonic": None}, "expected a channel 'ultrasonic' among them"),
        ({"ambient": "nose, tail [counts]"}, "['ambient_nose', 'ambient_tail']; expected 5 columns, one for"),
        (
            {"position": "left, right"},
            "channels['position']: unit of position_left = ''; expected one in brackets",
        ),
        (
            {"position": "left [mm], right [mm]"},
            "channels['position'] = ['position_left']; expected left and",
        ),
    ],
)
def test_a_missing_or_wrong_label_is_named(
    labels: dict[str, str | None], message: str, toy: RobotModel
) -> None:
    from toy_robot.model import LABELS

    kept_labels = {name: label for name, label in {**LABELS, **labels}.items() if label is not None}
    with pytest.raises(RobotModelError, match=re.escape(message)):
        check_model(replace(toy, channels=parse_channels(kept_labels)))


def test_registers_beyond_a_term_are_refused(toy: RobotModel) -> None:
    (term,) = toy.terms
    with pytest.raises(RobotModelError, match="term ultrasonic: register = 17; expected 0 to 16, as 1 of 17"):
        check_model(replace(toy, terms=(term._replace(register=17),)))


def offer(model: RobotModel, monkeypatch: pytest.MonkeyPatch) -> None:
    """Install a model in the Toy's place."""
    models = {**registry.installed_models(), "toy": model}
    monkeypatch.setattr(registry, "installed_models", lambda: models)


def test_conform_refuses_another_host_class_and_a_pattern_that_does_not_match(
    toy: RobotModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    host = EntryPoint("host", toy.parts["host"], registry.GROUP).load()
    for name in ("toy_robot.hosts.Toy", "Toy", "khep_twin.Khepera"):
        with pytest.raises(RobotModelError, match=f"host_class = '{name}'; expected toy_robot.host.Toy$"):
            check_identity(changed(toy, "dialect", host_class=name), host, None)
    monkeypatch.setattr(host, "dialect", dialect := toy.dialect._replace(versions_reply=re.compile("C5")))
    offer(replace(toy, dialect=dialect), monkeypatch)
    with pytest.raises(
        RobotModelError, match=r"versions_reply = 'C5'; expected a pattern .*, 'C501546F7901FD'$"
    ):
        conform("khep://default?model=toy", model="toy")


def test_a_world_refuses_a_number_of_registers_unlike_that_of_the_core(
    toy: RobotModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    offer(changed(toy, "interface", n_registers=19), monkeypatch)
    playpen = playpens.Playpen.load("default")
    robots = (
        playpen.robots[0].model_copy(update={"model": "toy", "calibration": toy.calibration, "rom": "toy-1"}),
    )
    toys = playpen.model_copy(update={"robots": robots})
    for make in (World, partial(rollout, driver=ConstantSpeed(0, 0), seeds=[1], seconds=0.1, planar=True)):
        with pytest.raises(
            RobotModelError, match="n_registers = 19; expected 17, the number of registers in its core"
        ):
            make(toys)


def test_wheels_of_a_body_and_of_its_usual_calibration_are_the_same(toy: RobotModel) -> None:
    for model in registry.installed_models().values():
        calibration.read_for(model.calibration, model)
    with pytest.raises(
        CalibrationError, match=r"wheels: base_mm = 70; expected 71, as body\.wheel_base of model toy"
    ):
        calibration.read_for(toy.calibration, changed(toy, "body", wheel_base=0.071))


@pytest.mark.parametrize(
    ("model", "text"),
    [
        ("khepera2", ": BIOS 6.01, protocol 5.01 at 9600 baud"),
        ("khepera3", ": Khepera III, b,3,0 at 115200 baud"),
        ("khepera4", ": Khepera IV, b,B,0 at 115200 baud"),
        ("toy", ": Toy, C501546F7901FD at 9600 baud"),
    ],
)
def test_a_probe_identifies_a_robot_of_any_model(
    model: str, text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    with open_twin("default", TwinOptions(model=model)) as twin:
        monkeypatch.setattr(discovery, "port_user", lambda url: "")
        monkeypatch.setattr(discovery, "open_port", lambda *_, **options: Serial.of(twin, 1.0))
        assert _describe_robot("/dev/robot") == text


def test_a_line_is_identified_after_noise_and_with_any_letters(
    toy: RobotModel, monkeypatch: pytest.MonkeyPatch
) -> None:
    dialect = toy.dialect._replace(framing=LINES, probes=("I",), versions_reply=re.compile("i,blob,[0-9]+"))
    families = {"toy": replace(toy, dialect=dialect)}
    monkeypatch.setattr(opening, "installed_families", lambda: families)
    port: Any = serial.serial_for_url("loop://", timeout=0.1)
    monkeypatch.setattr(port, "write", lambda data: None)
    monkeypatch.setattr(port, "reset_input_buffer", lambda: port.queue.queue.clear())
    monkeypatch.setattr(port, "read_until", lambda *_: b"xi,b\xffi,blob,7\r\n")
    assert opening.find_baud_rate(port, "loop", lambda: 0.0) == (9600, "i,blob,7")


def test_a_term_of_another_model_is_refused_with_the_model_whose_terms_are_listed() -> None:
    with pytest.raises(
        KhepTwinError, match=r"model khepera: observation term 'ultrasonic': unknown; .*charge"
    ):
        Task("look", "default", ("ultrasonic",), lambda state: 1.0)
    assert Task("look", "default", ("ultrasonic",), lambda state: 1.0, model="toy").terms["ultrasonic"]


def test_an_error_in_the_code_of_a_part_is_one_line(
    toy: RobotModel, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "broken_part.py").write_text("def f(:\n")
    monkeypatch.syspath_prepend(tmp_path)
    model = replace(toy, parts={**toy.parts, "core": "broken_part:CORE"})
    with pytest.raises(RobotModelError) as caught:
        model.load("core", object)
    assert str(caught.value) == (
        "model toy: broken_part:CORE cannot be loaded: SyntaxError: invalid syntax (broken_part.py, line 1)"
    )
