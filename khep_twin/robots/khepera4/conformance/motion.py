"""Checks of commands that move a Khepera IV."""

from khep_twin.lab.conformance.port.check import CheckedPort, Deviation, check, expect_range
from khep_twin.lab.conformance.port.driving import STOPPING, drive, drive_to, expect_standing
from khep_twin.robots.khepera4.conformance.grammar import PUBLISHED, expect_refused

FORWARD = "drives up to 40 cm forwards and back"
SPIN = "turns on the spot"
ANYWHERE = "drives for 2 s without commands, around obstacles"

NEAR = 200
"""Largest distance from its target of a wheel that has stopped [pulses]: ten margins."""


@check("D drives both wheels at the requested speed, which E reads", "6, commands D and E", FORWARD)
def driven_speed(line: CheckedPort) -> None:
    line.order("M")
    for speed in (200, -200):
        line.order(f"D,{speed},{speed}", pause=1.2)
        speeds, distances = line.numbers("E", 2), drive(line, f"D,{speed},{speed}", 0.3)
        expect_range("E", [value * speed // 200 for value in speeds], 180, 220)
        expect_range("R", [distance * speed // 200 for distance in distances], 5000, 7500)


@check("D drives the left and the right wheel in this order", "6, command D", SPIN)
def wheel_order(line: CheckedPort) -> None:
    for left, right in ((150, -150), (-150, 150)):
        distances = drive(line, f"D,{left},{right}", 0.7)
        if min(distances[0] * left, distances[1] * right) <= 0:
            raise Deviation(f"D,{left},{right} moved the positions by {distances}")


@check("F drives to positions along the profile, and stops there", "6, command F", FORWARD)
def targets(line: CheckedPort) -> None:
    line.order("M", "I")
    for target in (30_000, 0):
        took = drive_to(line, f"F,{target},{target}", target, NEAR)
        if not 1.3 < took < 4:
            raise Deviation(f"30000 pulses took {took:.2f} s; expected about 2 s")


@check("J sets the speed of F", "6, command J", FORWARD)
def profile(line: CheckedPort) -> None:
    line.order("M", "I", "J,3,0,20,1,100")
    took = drive_to(line, "F,20000,20000", 20_000, NEAR)
    line.order("J,3,0,20,1,400")
    drive_to(line, "F,0,0", 0, NEAR)
    if not 1.9 < took < 5:
        raise Deviation(f"with J,3,0,20,1,100 20000 pulses took {took:.2f} s; expected 2 s and some settling")


@check("H sets the gains: a small P alone stays far below the setpoint", "6, command H", FORWARD)
def gains(line: CheckedPort) -> None:
    line.order("H,10,0,0", "D,500,500", pause=0.8)
    speeds = line.numbers("E", 2)
    line.order("D,-500,-500", pause=0.8)
    line.order("H,10,5,1", "D,0,0", pause=STOPPING)
    expect_range("E", speeds, 100, 350)


@check("L drives the motors open loop", "6, command L", FORWARD)
def open_loop(line: CheckedPort) -> None:
    for duty in (600, -600):
        distances = drive(line, f"L,{duty},{duty}", 0.5)
        if min(distance * duty for distance in distances) <= 0:
            raise Deviation(f"L,{duty},{duty} moved the positions by {distances}")


@check("M stops the motors", "6, command M", FORWARD)
def idle(line: CheckedPort) -> None:
    line.order("D,150,150", pause=0.4)
    line.order("M")
    expect_standing(line, "after M in motion")
    line.order("D,-150,-150", pause=0.4)
    line.order("D,0,0", pause=STOPPING)


@check("Z stops the motors and sets the positions to 0", "6, command Z", FORWARD)
def reset_in_motion(line: CheckedPort) -> None:
    line.order("D,150,150", pause=0.4)
    line.order("Z")
    expect_standing(line, "after Z in motion")
    line.order("Z", pause=0.1)
    expect_range("R", line.numbers("R", 2), -50, 50)
    line.order("M", "D,-150,-150", pause=0.4)
    line.order("D,0,0", pause=STOPPING)


@check("A drives without commands, also after a D, until A,2", "6, command A", ANYWHERE)
def vehicle(line: CheckedPort) -> None:
    line.order("A,0", "D,0,0", pause=0.8)
    if not any(speeds := line.numbers("E", 2)):
        raise Deviation(f"after A,0 and D,0,0 E gave {speeds}; expected a robot that still drives")
    line.order("A,2")
    expect_standing(line, "after A,2")
    line.order("M")


@check("an A that is refused also ends the vehicle", PUBLISHED, ANYWHERE)
def refused_vehicle(line: CheckedPort) -> None:
    line.order("A,1", pause=0.4)
    expect_refused(line, "A,3")
    expect_standing(line, "after A,3")
    line.order("M")
