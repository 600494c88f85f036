"""The gripper's electronics: orders, replies and motion of the setpoints."""

import pytest

from khep_twin.board.gripper import ARM_SPEED, FINGER_SPEED, FRACTION, GripperElectronics, Register


@pytest.fixture
def gripper() -> GripperElectronics:
    return GripperElectronics()


@pytest.mark.parametrize(
    ("order", "reply"),
    [
        ("B", "t,1,b,1,0"),
        ("D,0", "t,1,d"),
        ("D,1", "t,1,d"),
        ("E,255", "t,1,e"),
        ("E,-5", "t,1,e"),
        ("F", "t,1,f,255"),
        ("G", "t,1,g,0"),
        ("H,0", "t,1,h,200"),
        ("H,1", "t,1,h,152"),
        ("J", "t,1,j,0"),
        *((order, "z,Protocol error") for order in ("D", "D,2", "D,x", "E", "E,1,2", "H", "H,2", "F,1")),
        *((order, "z,Turret order not supported") for order in ("Q", "b", "\xff")),
    ],
)
def test_every_order_gets_its_reply(gripper: GripperElectronics, order: str, reply: str) -> None:
    assert gripper.receive(order.encode("latin-1")) == reply.encode() + b"\r\n"


@pytest.mark.parametrize(("sent", "position"), [(0, 152), (151, 152), (200, 200), (256, 255), (99999, 255)])
def test_the_arm_goes_no_further_than_its_ends(gripper: GripperElectronics, sent: int, position: int) -> None:
    gripper.receive(b"E,%d" % sent)
    assert gripper.registers[Register.ARM_TARGET] == position


def test_arm_and_fingers_run_at_their_speed_and_stop_where_they_are_sent(gripper: GripperElectronics) -> None:
    gripper.receive(b"E,255")
    gripper.receive(b"D,1")
    places = []
    for _ in range(120):
        gripper.tick()
        places.append(gripper.registers[[Register.ARM_SETPOINT, Register.FINGER_SETPOINT]].tolist())
    assert places[9] == [152 * FRACTION + 10 * ARM_SPEED, 200 * FRACTION - 10 * FINGER_SPEED]
    assert places[-1] == [255 * FRACTION, 0]


def test_a_reset_stops_both_where_they_are(gripper: GripperElectronics) -> None:
    gripper.receive(b"E,255")
    for _ in range(20):
        gripper.tick()
    gripper.registers[[Register.ARM_POSITION, Register.FINGER_POSITION]] = 170, 90
    gripper.reset()
    gripper.tick()
    assert gripper.registers[[Register.ARM_SETPOINT, Register.FINGER_SETPOINT]].tolist() == [
        170 * FRACTION,
        90 * FRACTION,
    ]
