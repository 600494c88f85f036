"""Checks of commands that move the robot."""

from khep_twin.lab.conformance.port.check import (
    SETTLE,
    CheckedPort,
    Deviation,
    NotPossibleError,
    check,
    expect_range,
)
from khep_twin.units import N_SENSORS

FORWARD = "drives about 80 mm forwards and as far back"
SPIN = "turns on the spot, about a quarter turn each way"
TO_A_WALL = "drives forwards to a light-coloured object, up to 40 cm, turns there and comes back"

NEAR, SEEN = 600, 100
"""Proximity at which the robot is near enough to a wall, and rise of a sensor that sees a thing [counts]."""

_NEEDED = "needs a light-coloured wall straight ahead, with nothing else near"

TIME_TO_A_WALL = 5.0
"""Longest drive to the wall, at 80 mm/s [s]."""

QUARTER_PULSES = 510
"""Pulses of each wheel for a quarter turn on the spot: wheels 52 mm apart, 0.08 mm per pulse."""


def _drive_to(line: CheckedPort, left: int, right: int) -> float:
    """Send the wheels to a target; return the time until both are there [s]."""
    line.order(f"C,{left},{right}")
    start = line.time()
    limit = 5 + max(abs(left), abs(right)) / 1000
    while (status := line.numbers("K", 6))[0] + status[3] < 2:
        if line.time() - start > limit:
            raise Deviation(f"C,{left},{right} was not on target after {limit:.0f} s: K gave {status}")
    return line.time() - start


def _travelled(line: CheckedPort, command: str, left: int, right: int, duration: float) -> list[int]:
    """Apply D or P for a duration [s] and stop; return the change of the counters [pulses]."""
    before = line.numbers("H", 2)
    line.order(f"{command},{left},{right}", pause=duration)
    after = line.numbers("H", 2)
    line.order(f"{command},0,0", pause=0.3)
    return [now - then for then, now in zip(before, after, strict=True)]


def _expect_profile_time(took: float) -> None:
    # From rest over 1000 pulses at 0.25 pulses per tick^2: 2 sqrt(1000 / 0.25) ticks are 1.26 s.
    if not 1.1 < took < 2.0:
        raise Deviation(f"1000 pulses took {took:.2f} s; expected 1.26 s and some settling")


@check("D drives both wheels at the requested speed", "A, command D", FORWARD)
def driven_speed(line: CheckedPort) -> None:
    for sign in (1, -1):
        line.order("G,0,0", f"D,{10 * sign},{10 * sign}")
        start = line.time()
        line.sleep(1.0)
        speeds = line.numbers("E", 2)
        counts = line.numbers("H", 2)
        took = line.time() - start
        line.order("D,0,0", pause=0.5)
        expect_range("E", [sign * speed for speed in speeds], 7, 13)
        # 10 pulses per 10 ms are 1000 a second, less the start.
        expect_range("H", [sign * count for count in counts], int(800 * took), int(1050 * took))


@check("E reads the measured speeds, not the setpoints", "A, command E", SPIN)
def measured_speeds(line: CheckedPort) -> None:
    for left, right in ((40, -40), (-40, 40)):
        line.order(f"P,{left},{right}", pause=0.4)
        speeds = line.numbers("E", 2)
        line.order("P,0,0", "D,0,0", pause=0.4)
        if speeds[0] * left <= 0 or speeds[1] * right <= 0:
            raise Deviation(f"P,{left},{right} turned the wheels at the speeds {speeds} by E")


@check("K reads the left wheel first, and the error left", "A, command K", FORWARD)
def status_of_each_wheel(line: CheckedPort) -> None:
    line.order("J,20,64,20,64", "G,0,0", "C,1000,0", pause=0.6)
    status = line.numbers("K", 6)
    if status[:5:3] != [0, 1]:
        raise Deviation(f"with only the left wheel moving K gave {status}; expected T 0 and 1")
    line.sleep(1.5)
    _drive_to(line, 0, 0)
    for target, sign in ((1000, 1), (0, -1)):
        line.order(f"C,{target},{target}")
        errors: list[int] = []
        for _ in range(12):
            errors += [error * sign for error in line.numbers("K", 6)[2::3]]
            line.sleep(0.04)
        _drive_to(line, target, target)
        if max(errors) <= 0:
            raise Deviation(f"on the way to C,{target},{target} K gave no error towards the target")
    line.order("D,0,0")


@check("G in motion sets the counters and stops nothing", "A, command G", FORWARD)
def counters_in_motion(line: CheckedPort) -> None:
    line.order("D,10,10", pause=0.5)
    line.order("G,0,-5000", pause=0.5)
    left, right = line.numbers("H", 2)
    line.order("D,-10,-10", pause=1.0)
    line.order("D,0,0", pause=0.4)
    expect_range("H", [left, right + 5000], 350, 800)


@check("J sets speed and acceleration of both wheels", "A, command J", FORWARD)
def profiles(line: CheckedPort) -> None:
    line.order("G,0,0")
    # 1000 pulses: at 10 pulses/tick 100 ticks and a ramp of 40; at 16/256 pulse/tick^2 2 sqrt(16000) ticks.
    for profile, target, right in (("10,64,10,64", 1000, 1.4), ("20,16,20,16", 0, 2.53)):
        line.order(f"J,{profile}")
        took = _drive_to(line, target, target)
        if not 0.9 * right < took < right + 0.6:
            raise Deviation(
                f"with J,{profile} 1000 pulses took {took:.2f} s; expected {right} s and some settling"
            )
    line.order("J,20,64,20,64")


@check("C goes to positions below zero and beyond 16 bits", "A, command C", FORWARD)
def far_positions(line: CheckedPort) -> None:
    for start, target in ((0, -500), (70_000, 70_500)):
        line.order(f"G,{start},{start}")
        _drive_to(line, target, target)
        expect_range("H", [count - target for count in line.numbers("H", 2)], -3, 3)
    line.order("D,0,0")


@check("a restart stops the motors", "3.2.1, tool restart", FORWARD)
def restart_in_motion(line: CheckedPort) -> None:
    line.order("D,8,8", pause=0.3)
    line.send("restart\n")
    line.read_until_quiet(SETTLE)
    line.sleep(0.3)
    before = line.numbers("H", 2)
    line.sleep(0.4)
    after = line.numbers("H", 2)
    line.order("D,-8,-8", pause=0.4)
    line.order("D,0,0")
    if max(abs(now - then) for then, now in zip(before, after, strict=True)) > 5:
        raise Deviation(f"after a restart in motion the counters went on from {before} to {after}")


@check("D drives the left and the right wheel in this order", "A, command D", SPIN)
def wheel_order(line: CheckedPort) -> None:
    line.order("G,0,0")
    for left, right in ((5, -5), (-5, 5)):
        pulses = _travelled(line, "D", left, right, 0.7)
        if pulses[0] * left <= 100 or pulses[1] * right <= 100:
            raise Deviation(f"D,{left},{right} moved the counters by {pulses}")


@check("C goes to a position along the profile and reports arrival", "A, commands C and J", FORWARD)
def position(line: CheckedPort) -> None:
    line.order("J,20,64,20,64", "G,0,0")
    for target in (1000, 0):
        took = _drive_to(line, target, target)
        _expect_profile_time(took)
        expect_range("H", [count - target for count in line.numbers("H", 2)], -3, 3)
        expect_range("K", line.numbers("K", 6)[2::3], -3, 3)


@check("a restart sets the profile to 20 and 64", "A, command J", FORWARD)
def profile_after_restart(line: CheckedPort) -> None:
    line.order("J,5,5,5,5")
    line.send("restart\n")
    line.read_until_quiet(SETTLE)
    for target in (1000, 0):
        _expect_profile_time(_drive_to(line, target, target))


@check("the sensors come in the manual's order, clockwise from the left", "A, command N", TO_A_WALL)
def sensor_order(line: CheckedPort) -> None:
    line.order("D,0,0", "G,0,0")
    before = line.numbers("N", N_SENSORS)
    line.order("D,10,10")
    start = line.time()
    # Any sensor may see it first: the order is what is asked.
    while not any(
        now >= NEAR and now - then >= SEEN
        for then, now in zip(before, line.numbers("N", N_SENSORS), strict=True)
    ):
        if line.time() - start > TIME_TO_A_WALL:
            line.order("D,0,0")
            _drive_to(line, 0, 0)
            raise NotPossibleError(f"no sensor saw anything within 40 cm; {_NEEDED}")
    line.order("D,0,0", pause=0.3)
    here = line.numbers("H", 2)[0]
    found: list[list[int]] = []
    for turn in (0, QUARTER_PULSES, -QUARTER_PULSES, -2 * QUARTER_PULSES):
        _drive_to(line, here + turn, here - turn)
        line.sleep(0.1)
        found.append(line.numbers("N", N_SENSORS))
    _drive_to(line, here, here)
    _drive_to(line, 0, 0)
    line.order("D,0,0")
    # Above what each reads where it looks elsewhere: those of a Khepera II never read 0.
    least = [min(counts) for counts in zip(*found, strict=True)]
    rises = [[now - low for now, low in zip(counts, least, strict=True)] for counts in found]
    if any(max(rise) < SEEN for rise in rises):
        raise NotPossibleError(f"the object was out of sight after a turn; {_NEEDED}")
    sides = ((2, 3), (0, 1), (4, 5), (6, 7))
    if any(max(rise[i] for i in side) < max(rise) / 2 for rise, side in zip(rises, sides, strict=True)):
        seen = [rise.index(max(rise)) for rise in rises]
        raise Deviation(
            f"with a wall ahead, left, right and behind the sensors {seen} of N read the highest counts; "
            "expected 2 or 3, 0 or 1, 4 or 5, 6 or 7"
        )


@check("P drives the motors open loop", "A, command P", FORWARD)
def open_loop(line: CheckedPort) -> None:
    line.order("G,0,0")
    for duty in (40, -40):
        pulses = _travelled(line, "P", duty, duty, 0.4)
        if min(each * duty for each in pulses) <= 0:
            raise Deviation(f"P,{duty},{duty} moved the counters by {pulses}")
    line.order("D,0,0")


@check("a value beyond the range is accepted and keeps its sign", "A, commands D and P", FORWARD)
def saturation(line: CheckedPort) -> None:
    line.order("P,0,0", "D,0,0", "G,0,0", "P,999,999", "D,0,0", "D,999,999", "D,0,0", pause=0.5)
