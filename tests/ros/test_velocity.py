"""Velocity commands as setpoints of wheels."""

import math

import pytest

from khep_twin.errors import KhepTwinError
from khep_twin.robots.registry import find_model, installed_models
from khep_twin.ros.velocity import TWIST, TWIST_STAMPED, Setpoints, Velocity, setpoint_limit, setpoints_of


def twist(forward: float, turn: float) -> dict[str, dict[str, float]]:
    return {"linear": {"x": forward, "y": 9.0}, "angular": {"z": turn}}


def test_both_forms_of_a_command_have_the_same_velocity() -> None:
    assert Velocity.of_message(TWIST, twist(0.1, -2.0)) == Velocity(0.1, -2.0)
    assert Velocity.of_message(TWIST_STAMPED, {"twist": twist(0.1, -2.0)}) == Velocity(0.1, -2.0)


@pytest.mark.parametrize("speeds", [(math.nan, 0.0), (0.0, math.inf), (-math.inf, math.nan)])
def test_a_speed_that_is_not_finite_is_refused(speeds: tuple[float, float]) -> None:
    with pytest.raises(
        KhepTwinError, match=r"linear\.x = .*, angular\.z = .*: the robot stops; expected finite numbers"
    ):
        Velocity.of_message(TWIST, twist(*speeds))


def test_a_khepera_turns_by_the_distance_of_its_wheels() -> None:
    khepera = find_model("khepera1")
    assert setpoints_of(khepera, Velocity(0.08, 0.0), 127) == Setpoints(10, 10, False)
    assert setpoints_of(khepera, Velocity(0.0, 2 * 0.08 / 0.053), 127) == Setpoints(-10, 10, False)
    assert setpoints_of(khepera, Velocity(0.08, -0.08 / 0.053), 127) == Setpoints(15, 5, False)


@pytest.mark.parametrize("name", installed_models())
def test_every_model_drives_at_the_commanded_speed(name: str) -> None:
    model = find_model(name)
    setpoints = setpoints_of(model, Velocity(0.08, 0.0), setpoint_limit(model))
    pulses = setpoints.left / model.episode_interface.speed_per_pulse
    assert setpoints.left == setpoints.right
    assert pulses * model.body.pulse_length / 0.01 == pytest.approx(0.08, rel=0.05)


@pytest.mark.parametrize("name", installed_models())
@pytest.mark.parametrize("factor", [100.0, 1e300])
def test_a_velocity_beyond_the_motors_is_clamped_and_keeps_its_curvature(name: str, factor: float) -> None:
    model = find_model(name)
    limit, base = setpoint_limit(model), model.body.wheel_base
    largest = round(limit)
    setpoints = Setpoints(round(limit / 3), largest, True)
    assert setpoints_of(model, Velocity(factor, factor / base), limit) == setpoints
    assert setpoints_of(model, Velocity(-1.7e308, 0.0), limit) == Setpoints(-largest, -largest, True)


@pytest.mark.parametrize(
    ("name", "speed"), [("khepera1", 1.016), ("khepera3", 0.1966), ("khepera4", 58.18 * 0.021)]
)
def test_the_limit_is_the_speed_of_an_unloaded_motor_or_that_of_the_protocol(name: str, speed: float) -> None:
    model = find_model(name)
    unit = 0.01 * model.episode_interface.speed_per_pulse / model.body.pulse_length
    assert setpoint_limit(model) / unit == pytest.approx(speed, rel=1e-3)
