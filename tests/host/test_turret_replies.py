"""Malformed replies of turrets, as on a disturbed line."""

from collections.abc import Callable

import pytest

from khep_twin.errors import ProtocolError
from khep_twin.host import Gripper, Khepera, Radio
from stand_ins.fake_robot import FakeRobot

REPLIES: dict[str, tuple[Callable[[Khepera], Callable[[], object]], str, str]] = {
    "a byte above 255": (lambda robot: Radio(robot).receive, "t,4,r,2,2,300,1" + ",0" * 14, "of 0 to 255"),
    "a long message": (lambda robot: Radio(robot).receive, "t,4,r,2,17" + ",0" * 16, "at most 16"),
    "thousands of digits": (lambda robot: Gripper(robot).arm, "t,1,h," + "1" * 5000, "answered 'H,1'"),
    "another command's": (lambda robot: Gripper(robot).open, "t,1,h,99", "answered 'D,0' with 'h,99'"),
}


@pytest.mark.parametrize("name", REPLIES)
def test_a_reply_that_is_none_is_a_protocol_error(name: str) -> None:
    read_of, reply, line = REPLIES[name]
    with FakeRobot() as fake, Khepera(fake.url) as robot:
        fake.answers["T"] = f"{reply[:4]}b,1,0"
        read = read_of(robot)
        fake.answers["T"] = reply
        with pytest.raises(ProtocolError, match=line):
            read()
