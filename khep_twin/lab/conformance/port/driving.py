"""Motion in checks of robots with the commands A, D and R of a Khepera IV."""

from khep_twin.lab.conformance.port.check import CheckedPort, Deviation

STOPPING = 0.6
"""Time in which a robot stops from any speed of the checks [s]."""


def drive(line: CheckedPort, order: str, duration: float) -> list[int]:
    """Drive by a command for a duration [s], then stop; return the change of the positions [pulses]."""
    starts = line.numbers("R", 2)
    line.order(order, pause=duration)
    ends = line.numbers("R", 2)
    line.order("D,0,0", pause=STOPPING)
    return [end - start for start, end in zip(starts, ends, strict=True)]


def drive_to(line: CheckedPort, order: str, target: int, near: int) -> float:
    """Send both wheels to a target by a command; return the time until they stop near it [s]."""
    line.order(order)
    start, previous = line.time(), [0, 0]
    while (now := line.numbers("R", 2)) != previous or max(abs(target - value) for value in now) > near:
        if (took := line.time() - start) > 8:
            raise Deviation(f"{order} was not on target after {took:.0f} s: R gave {now}")
        previous = now
        line.sleep(0.05)
    return line.time() - start


def expect_standing(line: CheckedPort, context: str, tolerance: int = 20) -> None:
    """Raise a `Deviation` if the positions still change by more than a tolerance [pulses]."""
    line.sleep(STOPPING)
    starts = line.numbers("R", 2)
    line.sleep(0.3)
    ends = line.numbers("R", 2)
    if max(abs(end - start) for start, end in zip(starts, ends, strict=True)) > tolerance:
        line.order("A,2", "D,0,0")
        raise Deviation(f"{context} the positions changed from {starts} to {ends}; expected a stop")
