"""Checks of commands that move a Khepera IV."""

from khep_twin.lab.conformance.khepera4.grammar import PUBLISHED, expect_refused
from khep_twin.lab.conformance.port.check import CheckedPort, Deviation, check, expect_range

FORWARD = "drives up to 40 cm forwards and as far back"
SPIN = "turns on the spot"
ANYWHERE = "drives on by itself for 2 s, around obstacles"

NEAR = 200
"""Distance from a target at which a wheel stands [pulses]: ten margins."""

_STOPPING = 0.6
"""Time in which it stops from any speed of these checks [s]."""


def _drive_to(line: CheckedPort, target: int) -> float:
    """Send both wheels to a target; return the time until they stand there [s]."""
    line.order(f"F,{target},{target}")
    start, before = line.time(), [0, 0]
    while (places := line.numbers("R", 2)) != before or max(abs(target - each) for each in places) > NEAR:
        if (took := line.time() - start) > 8:
            raise Deviation(f"F,{target},{target} was not on target after {took:.0f} s: R gave {places}")
        before = places
        line.sleep(0.05)
    return line.time() - start


def _travelled(line: CheckedPort, order: str, duration: float) -> list[int]:
    """Apply an order for a duration [s], and stop; return the change of the positions until then [pulses]."""
    before = line.numbers("R", 2)
    line.order(order, pause=duration)
    after = line.numbers("R", 2)
    line.order("D,0,0", pause=_STOPPING)
    return [now - then for then, now in zip(before, after, strict=True)]


def _expect_standing(line: CheckedPort, why: str) -> None:
    line.sleep(_STOPPING)
    before = line.numbers("R", 2)
    line.sleep(0.3)
    after = line.numbers("R", 2)
    if max(abs(now - then) for then, now in zip(before, after, strict=True)) > 20:
        line.order("A,2", "D,0,0")
        raise Deviation(f"{why} the positions went on from {before} to {after}; expected a robot that stands")


@check("D drives both wheels at the requested speed, which E reads", "6, commands D and E", FORWARD)
def driven_speed(line: CheckedPort) -> None:
    line.order("M")
    for speed in (200, -200):
        line.order(f"D,{speed},{speed}", pause=1.2)
        told, ways = line.numbers("E", 2), _travelled(line, f"D,{speed},{speed}", 0.3)
        expect_range("E", [each * speed // 200 for each in told], 180, 220)
        expect_range("R", [each * speed // 200 for each in ways], 5000, 7500)


@check("D drives the left and the right wheel in this order", "6, command D", SPIN)
def wheel_order(line: CheckedPort) -> None:
    for left, right in ((150, -150), (-150, 150)):
        ways = _travelled(line, f"D,{left},{right}", 0.7)
        if min(ways[0] * left, ways[1] * right) <= 0:
            raise Deviation(f"D,{left},{right} moved the positions by {ways}")


@check("F goes to positions along the profile, and stands there", "6, command F", FORWARD)
def targets(line: CheckedPort) -> None:
    line.order("M", "I")
    for target in (30_000, 0):
        took = _drive_to(line, target)
        if not 1.3 < took < 4:
            raise Deviation(f"30000 pulses took {took:.2f} s; expected about 2 s")


@check("J sets the speed of F", "6, command J", FORWARD)
def profile(line: CheckedPort) -> None:
    line.order("M", "I", "J,3,0,20,1,100")
    took = _drive_to(line, 20_000)
    line.order("J,3,0,20,1,400")
    _drive_to(line, 0)
    if not 1.9 < took < 5:
        raise Deviation(f"with J,3,0,20,1,100 20000 pulses took {took:.2f} s; expected 2 s and some settling")


@check("H sets the gains: a small P alone stays far below an order", "6, command H", FORWARD)
def gains(line: CheckedPort) -> None:
    line.order("H,10,0,0", "D,500,500", pause=0.8)
    told = line.numbers("E", 2)
    line.order("D,-500,-500", pause=0.8)
    line.order("H,10,5,1", "D,0,0", pause=_STOPPING)
    expect_range("E", told, 100, 350)


@check("L drives the motors open loop", "6, command L", FORWARD)
def open_loop(line: CheckedPort) -> None:
    for duty in (600, -600):
        ways = _travelled(line, f"L,{duty},{duty}", 0.5)
        if min(way * duty for way in ways) <= 0:
            raise Deviation(f"L,{duty},{duty} moved the positions by {ways}")


@check("M stops the motors", "6, command M", FORWARD)
def idle(line: CheckedPort) -> None:
    line.order("D,150,150", pause=0.4)
    line.order("M")
    _expect_standing(line, "after M in motion")
    line.order("D,-150,-150", pause=0.4)
    line.order("D,0,0", pause=_STOPPING)


@check("Z stops the motors, and positions begin at 0", "6, command Z", FORWARD)
def reset_in_motion(line: CheckedPort) -> None:
    line.order("D,150,150", pause=0.4)
    line.order("Z")
    _expect_standing(line, "after Z in motion")
    line.order("Z", pause=0.1)
    expect_range("R", line.numbers("R", 2), -50, 50)
    line.order("M", "D,-150,-150", pause=0.4)
    line.order("D,0,0", pause=_STOPPING)


@check("A drives by itself through a D, until A,2", "6, command A", ANYWHERE)
def vehicle(line: CheckedPort) -> None:
    line.order("A,0", "D,0,0", pause=0.8)
    if not any(told := line.numbers("E", 2)):
        raise Deviation(f"after A,0 and D,0,0 E gave {told}; expected a robot that drives on")
    line.order("A,2")
    _expect_standing(line, "after A,2")
    line.order("M")


@check("an A that is refused ends the vehicle, too", PUBLISHED, ANYWHERE)
def refused_vehicle(line: CheckedPort) -> None:
    line.order("A,1", pause=0.4)
    expect_refused(line, "A,3")
    _expect_standing(line, "after A,3")
    line.order("M")
