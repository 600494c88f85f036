"""A robot that finds a cylinder straight ahead, picks it up, carries it to the other side and puts it down.

python examples/02_pick_and_carry.py /dev/ttyUSB0     a robot with a gripper
python examples/02_pick_and_carry.py khep://gripper   a twin in this process
"""

import sys

from khep_twin import Gripper, Khepera

NEAR = 400  # counts of the front sensors about a centimetre from a bright object
HALF_TURN = 1021  # pulses of 0.08 mm: half a circle of the wheels, 52 mm apart

url = sys.argv[1] if len(sys.argv) > 1 else "khep://gripper"
with Khepera(url) as robot:
    gripper = Gripper(robot)
    gripper.lift()
    gripper.open()
    gripper.wait()

    robot.set_speed(5, 5)
    while max(robot.proximity()[2:4]) < NEAR:
        pass
    robot.set_speed(0, 0)
    gripper.lower()
    gripper.wait()

    robot.set_speed(2, 2)
    while gripper.barrier() < 200:  # until the object darkens the barrier between the fingers
        pass
    robot.set_speed(0, 0)
    gripper.close()
    gripper.wait()
    kind = "conducts" if gripper.resistivity() < 255 else "does not conduct"
    print(f"gripped with the fingers at {gripper.fingers()} of 200: it {kind}")

    gripper.lift()
    gripper.wait()
    robot.set_position(0, 0)
    for left, right in ((-HALF_TURN, HALF_TURN), (-HALF_TURN + 1200, HALF_TURN + 1200)):
        robot.set_target(left, right)
        robot.wait_for_target()

    gripper.lower()
    gripper.wait()
    gripper.open()
    gripper.wait()
    robot.set_speed(-5, -5)
    robot.sleep(1)
    robot.set_speed(0, 0)
    free = gripper.barrier() < 200
    gripper.lift()
    gripper.wait()

print("carried 96 mm back and put down" if free else "carried back, but it is still between the fingers")
if url.startswith("khep:"):
    print("to watch it: python examples/02_pick_and_carry.py 'khep://gripper?log=carry.mcap'")
    print("             khep-twin view carry.mcap")
