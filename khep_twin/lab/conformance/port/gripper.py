"""Checks of a gripper."""

from khep_twin.lab.conformance.port.check import CheckedPort, check, expect_range
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
        expect_range(f"T,1,{request}", line.numbers(f"T,1,{request}", 1), low, high)
    for order in "FGJ":
        expect_range(f"T,1,{order}", line.numbers(f"T,1,{order}", 1), 0, COUNTS_LIMIT)
