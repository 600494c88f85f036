"""Colours of sensors in plots over time."""

from dataclasses import replace

from khep_twin.robots.body import Body
from khep_twin.robots.registry import find_model
from khep_twin.sensing.colours import ALL_SENSORS, sensor_colours


def test_sensors_of_other_names_have_a_colour_by_their_bearing() -> None:
    body = find_model("khepera1").body
    assert sensor_colours(body) == {name: ALL_SENSORS[name] for name in body.sensors}
    names = tuple("abcdefgh")
    other: Body = replace(body, sensors=(*names, "floor"), ground_positions=((0.0, 0.0),))
    colours = sensor_colours(other)
    assert list(colours) == [*names, "floor"]
    assert len({colours[name] for name in names}) == 8
    (left_red, _, left_blue), (right_red, _, right_blue) = colours["a"], colours["f"]
    assert left_red > left_blue
    assert right_red < right_blue
    assert colours["floor"] == ALL_SENSORS["back"]
