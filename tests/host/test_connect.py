"""Connection to a robot of any model by its host class."""

from khep_twin.host import Khepera, Khepera4
from khep_twin.host.connection import connect
from stand_ins.fake_robot import FakeRobot


def test_a_twin_in_this_process_has_the_host_class_of_its_model() -> None:
    with connect("khep://arena4") as robot:
        assert isinstance(robot, Khepera4)
        assert robot.port.baudrate == 115_200
        assert robot.time == 0
    with connect("khep://default?mode=3") as robot:
        assert isinstance(robot, Khepera)
        assert robot.port.baudrate == 38_400


def test_a_robot_is_of_the_model_that_its_reply_names() -> None:
    with FakeRobot() as fake, connect(fake.url) as robot:
        assert isinstance(robot, Khepera)
        assert (robot.model.name, fake.requests[0]) == ("khepera1", "B")
    with FakeRobot() as fake:
        fake.answers["B"] = "b,A,1"
        for baudrate, expected in ((19_200, 19_200), (0, 115_200)):  # the fake robot answers at any
            with connect(fake.url, baudrate=baudrate) as robot:
                assert isinstance(robot, Khepera4)
                assert robot.port.baudrate == expected
