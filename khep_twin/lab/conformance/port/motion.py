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

FORWARD = "drives about 80 mm forwards and back"
SPIN = "turns on the spot, about a quarter turn each way"
TO_A_WALL = "drives forwards to a light-coloured object, up to 40 cm, turns there and drives back"

NEAR, RISE = 600, 100
"""Proximity at which the robot is near enough to a wall, and rise of a sensor at an object [counts]."""

_NEEDED = "needs a light-coloured wall straight ahead, with nothing else near"

TIME_TO_A_WALL = 5.0
"""Longest drive to the wall, at 80 mm/s [s]."""

QUARTER_PULSES = 510
"""Pulses of each wheel for a quarter turn on the spot: wheels 52 mm apart, 0.08 mm per pulse."""


def _drive_to(line: CheckedPort, left: int, right: int) -> float:
    """Send the wheels to a target; return the time until both reach it [s]."""
    line.order(f"C,{left},{right}")
    start = line.time()
    limit = 5 + max(abs(left), abs(right)) / 1000
    while (status := line.numbers("K", 6))[0] + status[3] < 2:
        if line.time() - start > limit:
            raise Deviation(f"C,{left},{right} was not on target after {limit:.0f} s: K gave {status}")
    return line.time() - start


def _drive(line: CheckedPort, command: str, left: int, right: int, duration: float) -> list[int]:
    """Apply D or P for a duration [s] and stop; return the change of the counters [pulses]."""
    starts = line.numbers("H", 2)
    line.order(f"{command},{left},{right}", pause=duration)
    ends = line.numbers("H", 2)
    line.order(f"{command},0,0", pause=0.3)
    return [end - start for start, end in zip(starts, ends, strict=True)]


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


@check("K reads the left wheel first, and the remaining error", "A, command K", FORWARD)
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


@check("G in motion sets the counters and does not stop the motors", "A, command G", FORWARD)
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
    for profile, target, duration in (("10,64,10,64", 1000, 1.4), ("20,16,20,16", 0, 2.53)):
        line.order(f"J,{profile}")
        took = _drive_to(line, target, target)
        if not 0.9 * duration < took < duration + 0.6:
            raise Deviation(
                f"with J,{profile} 1000 pulses took {took:.2f} s; expected {duration} s and some settling"
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
    starts = line.numbers("H", 2)
    line.sleep(0.4)
    ends = line.numbers("H", 2)
    line.order("D,-8,-8", pause=0.4)
    line.order("D,0,0")
    if max(abs(end - start) for start, end in zip(starts, ends, strict=True)) > 5:
        raise Deviation(f"after a restart in motion the counters changed from {starts} to {ends}")


@check("D drives the left and the right wheel in this order", "A, command D", SPIN)
def wheel_order(line: CheckedPort) -> None:
    line.order("G,0,0")
    for left, right in ((5, -5), (-5, 5)):
        pulses = _drive(line, "D", left, right, 0.7)
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
    background = line.numbers("N", N_SENSORS)
    line.order("D,10,10")
    start = line.time()
    # Any sensor may detect the wall first, as their order is not known yet.
    while not any(
        value >= NEAR and value - base >= RISE
        for base, value in zip(background, line.numbers("N", N_SENSORS), strict=True)
    ):
        if line.time() - start > TIME_TO_A_WALL:
            line.order("D,0,0")
            _drive_to(line, 0, 0)
            raise NotPossibleError(f"no sensor detected anything within 40 cm; {_NEEDED}")
    line.order("D,0,0", pause=0.3)
    position = line.numbers("H", 2)[0]
    readings: list[list[int]] = []
    for turn in (0, QUARTER_PULSES, -QUARTER_PULSES, -2 * QUARTER_PULSES):
        _drive_to(line, position + turn, position - turn)
        line.sleep(0.1)
        readings.append(line.numbers("N", N_SENSORS))
    _drive_to(line, position, position)
    _drive_to(line, 0, 0)
    line.order("D,0,0")
    # Above the reading of each sensor in other directions: those of a Khepera II never read 0.
    lowest = [min(counts) for counts in zip(*readings, strict=True)]
    rises = [[count - low for count, low in zip(counts, lowest, strict=True)] for counts in readings]
    if any(max(rise) < RISE for rise in rises):
        raise NotPossibleError(f"no sensor detected the object after a turn; {_NEEDED}")
    sides = ((2, 3), (0, 1), (4, 5), (6, 7))
    if any(max(rise[i] for i in side) < max(rise) / 2 for rise, side in zip(rises, sides, strict=True)):
        sensors = [rise.index(max(rise)) for rise in rises]
        raise Deviation(
            f"with a wall ahead, left, right and behind the sensors {sensors} of N read the highest counts; "
            "expected 2 or 3, 0 or 1, 4 or 5, 6 or 7"
        )


@check("P drives the motors open loop", "A, command P", FORWARD)
def open_loop(line: CheckedPort) -> None:
    line.order("G,0,0")
    for duty in (40, -40):
        pulses = _drive(line, "P", duty, duty, 0.4)
        if min(count * duty for count in pulses) <= 0:
            raise Deviation(f"P,{duty},{duty} moved the counters by {pulses}")
    line.order("D,0,0")


@check("a value beyond the range is accepted and keeps its sign", "A, commands D and P", FORWARD)
def saturation(line: CheckedPort) -> None:
    line.order("P,0,0", "D,0,0", "G,0,0", "P,999,999", "D,0,0", "D,999,999", "D,0,0", pause=0.5)
