"""Checks of a gripper."""

import re

from khep_twin.lab.conformance.port.check import CheckedPort, Deviation, check, expect_range
from khep_twin.units import COUNTS_LIMIT, GRIPPER_NUMBER

ARM = "moves the arm and the fingers of its gripper"


@check("a gripper opens, closes and moves its arm", "gripper manual", ARM, GRIPPER_NUMBER)
def moves(line: CheckedPort) -> None:
    # An object between the fingers may keep them open.
    opened, closed = ("D,0", 190, 210), ("D,1", -10, 150)
    arm = {place: (f"E,{place}", place - 10, place + 10) for place in (255, 190, 152)}
    for order, low, high in (opened, arm[255], closed, arm[190], opened, arm[152]):
        line.expect(f"T,1,{order}", f"t,1,{order[0].lower()}")
        line.sleep(1.5)
        request = "H,1" if order[0] == "E" else "H,0"
        answer = line.ask(f"T,1,{request}")
        if not re.fullmatch(r"t,1,h,\d+", answer):
            raise Deviation(f"'T,1,{request}' was answered {answer!r}; expected 't,1,h' and one number")
        expect_range(f"T,1,{request}", [int(answer.split(",")[3])], low, high)
    for order in "FGJ":
        answer = line.ask(f"T,1,{order}")
        if not re.fullmatch(rf"t,1,{order.lower()},\d+", answer):
            raise Deviation(
                f"'T,1,{order}' was answered {answer!r}; expected 't,1,{order.lower()}' and a number"
            )
        expect_range(f"T,1,{order}", [int(answer.split(",")[3])], 0, COUNTS_LIMIT)
