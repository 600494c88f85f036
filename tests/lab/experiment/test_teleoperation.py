"""Teleoperation: the dead-man's switch, the commands, and the screen."""

import pytest

from khep_twin.errors import PortError, PortTimeout
from khep_twin.host import Khepera, Khepera4, SensorCounts
from khep_twin.lab.experiment.teleoperation import (
    FASTEST,
    FIRST_HOLD,
    REPEAT_HOLD,
    WIDTH,
    DeadManSwitch,
    Direction,
    DriveState,
    Teleoperation,
    draw,
)
from khep_twin.robots.registry import default_model
from stand_ins.fake_robot import FakeRobot

_HEIGHT = 18
"""Lines of the smallest terminal for a Khepera."""


def test_a_press_drives_for_a_moment_and_a_key_that_is_held_drives_on() -> None:
    switch = DeadManSwitch()
    assert switch.direction(0.0) is Direction.STOP
    switch.press(Direction.FORWARD, 1.0)
    assert switch.direction(1.0 + FIRST_HOLD - 0.01) is Direction.FORWARD
    assert switch.direction(1.0 + FIRST_HOLD) is Direction.STOP
    # Held: the keyboard repeats the key, and the switch releases soon after the last repetition.
    for tick in range(20):
        switch.press(Direction.FORWARD, 10 + 0.1 * tick)
    assert switch.direction(10 + 1.9 + REPEAT_HOLD - 0.01) is Direction.FORWARD
    assert switch.direction(10 + 1.9 + REPEAT_HOLD) is Direction.STOP
    # Another direction counts as a first press, and space stops immediately.
    switch.press(Direction.LEFT, 20.0)
    assert switch.direction(20.0 + REPEAT_HOLD) is Direction.LEFT
    switch.press(Direction.STOP, 20.1)
    assert switch.direction(20.1) is Direction.STOP


@pytest.mark.parametrize(
    ("direction", "speed", "speeds"),
    [
        (Direction.FORWARD, 5, (5, 5)),
        (Direction.BACK, 40, (-40, -40)),
        (Direction.LEFT, 5, (-3, 3)),
        (Direction.RIGHT, 1, (1, -1)),
        (Direction.STOP, 9, (0, 0)),
    ],
)
def test_ways_are_speeds_of_the_wheels(direction: Direction, speed: int, speeds: tuple[int, int]) -> None:
    assert direction.speeds(speed) == speeds


def test_only_what_changes_is_sent() -> None:
    now = 0.0
    with FakeRobot() as fake, Khepera(fake.url) as robot:
        operation = Teleoperation(robot, 5, lambda: now)
        operation.cycle()
        assert fake.requests == ["D,0,0", "L,0,0", "L,1,0", "N", "O", "E", "I,0"]
        operation.press(Direction.FORWARD)
        operation.switch_leds()
        for now in (0.1, 0.2, FIRST_HOLD - 0.01, FIRST_HOLD):
            fake.requests.clear()
            operation.cycle()
            if now == 0.1:
                assert fake.requests == ["D,5,5", "L,0,1", "L,1,0", "N", "O", "E"]
            elif now < FIRST_HOLD:
                assert fake.requests == ["N", "O", "E"]
        assert fake.requests == ["D,0,0", "N", "O", "E"]
        view = operation.state
        assert (view.direction, view.leds, view.lost) == (
            Direction.STOP,
            {"lateral": True, "frontal": False},
            0,
        )
        assert view.proximity[-1] == 1023
        assert view.ambient[0] == 500
        assert view.supply == pytest.approx(5.0)


def test_a_khepera_4_drives_at_its_speeds_and_shows_its_sensors_in_its_units() -> None:
    with Khepera4("khep://arena4") as robot:
        requests: list[str] = []
        robot.listen(lambda request, reply: requests.append(request))
        operation = Teleoperation(robot, 5, lambda: robot.time)
        operation.press(Direction.FORWARD)
        operation.switch_leds()
        operation.cycle()
        assert requests == ["D,150,150", "K,63,63,63,0,0,0,0,0,0", "N", "O", "E"]
        robot.sleep(0.5)
        operation.cycle()
        lines = draw(operation.state, "a port", 80, 24)
    assert operation.state.measured == pytest.approx((150, 150), abs=20)
    assert sum(line.startswith("ground ") for line in lines) == 4
    assert any(line.startswith("wheels") and line.endswith(" mm/s)") for line in lines)
    assert any(line.startswith("LEDs") and "left on   right off  back off" in line for line in lines)


def test_the_speed_stays_within_its_bounds() -> None:
    with FakeRobot() as fake, Khepera(fake.url) as robot:
        operation = Teleoperation(robot, 5)
        operation.set_speed(0)
        assert operation.state.speed == 1
        operation.set_speed(99)
        assert operation.state.speed == FASTEST


def test_one_lost_reply_is_lived_with_and_a_lost_line_is_not() -> None:
    with FakeRobot() as fake, Khepera(fake.url, 0.2) as robot:
        operation = Teleoperation(robot, 5)
        fake.answers["D"] = "x"
        operation.cycle()
        assert operation.state.lost == 1
        del fake.answers["D"]
        fake.requests.clear()
        operation.cycle()
        # It is unknown which commands were executed, so all are sent again.
        assert fake.requests[0] == "D,0,0"
        fake.silent = True
        operation.cycle()
        with pytest.raises(PortTimeout):
            operation.cycle()
        fake.silent = False


def test_an_unknown_supply_is_not_shown() -> None:
    with FakeRobot() as fake, Khepera(fake.url) as robot:
        fake.answers["I"] = "z,Protocol error"
        operation = Teleoperation(robot, 5)
        for _ in range(3):
            operation.cycle()
        assert fake.requests.count("I,0") == 2  # asked, and once more as any read is
        assert operation.state.supply is None
        assert "supply" not in "\n".join(draw(operation.state, "port", 80, 24))


def test_the_end_stops_the_motors_even_when_the_line_has_gone() -> None:
    with FakeRobot() as fake, Khepera(fake.url) as robot:
        operation = Teleoperation(robot, 5)
        operation.press(Direction.FORWARD)
        stops = iter([False, False, True])
        operation.run(lambda: next(stops))
        assert fake.requests.count("D,5,5") == 1
        assert fake.requests[-1] == "D,0,0"


@pytest.mark.filterwarnings("ignore:unclosed <socket", "ignore::pytest.PytestUnraisableExceptionWarning")
def test_a_line_that_breaks_ends_the_drive_and_a_robot_that_comes_back_is_stopped() -> None:
    def drive(fake: FakeRobot) -> None:
        with Khepera(fake.url) as robot:
            operation = Teleoperation(robot, 5)
            operation.press(Direction.FORWARD)
            operation.cycle()
            fake.disconnect()
            operation.run(lambda: False)

    with FakeRobot() as fake:
        with pytest.raises(PortError, match="the port was opened again and the motors were stopped"):
            drive(fake)
        assert fake.requests[-1] == "D,0,0"


def test_the_screen_shows_bars_that_grow_with_what_is_near_and_dark() -> None:
    near = SensorCounts(0, 1023, 512, 0, 0, 0, 0, 0)
    dark = SensorCounts(0, 512, 0, 0, 0, 0, 0, 0)
    leds = {"lateral": True, "frontal": False}
    view = DriveState(default_model(), 7, Direction.LEFT, (-3, 4), near, dark, leds, 4.8, 2)
    for width in (WIDTH, 80, 133):
        lines = draw(view, "a port with a long name" * 9, width, _HEIGHT)
        assert len(lines) <= _HEIGHT
        assert max(map(len, lines)) < width
        assert lines[3].count("#") == 0
        assert lines[4].count(".") == 0
        assert abs(lines[5].count("#") * 4 - lines[4].count("#")) <= 2
    assert "left   -3  right    4 pulses/10 ms   (-24, 32 mm/s)" in "\n".join(lines)
    assert "left, speed 7   2 replies lost" in "\n".join(lines)
    assert "lateral on   frontal off   supply about 4.8 V" in "\n".join(lines)


def test_in_a_small_terminal_the_error_says_how_large_it_must_be() -> None:
    state = DriveState(default_model(), 5, proximity=[0] * 8)
    assert draw(state, "port", 60, 24) == ["60 x 24 characters; expected at least 64 x 18; q ends"]
    assert draw(state, "port", 80, 5) == ["80 x 5 characters; expected at least 64 x 18; q ends"]
    assert draw(state, "port", 9, 5) == ["9 x 5 ch"]
    assert draw(state, "port", 0, 0) == [""]
