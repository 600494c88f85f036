"""Checks of a Scout at a port."""

from khep_twin.lab.conformance.port.check import Catalogue, CheckedPort, Deviation, check
from second_robot.model import N_VALUES, READS


@check("each read gives its number of values, a malformed request -1", "assumed")
def reads(line: CheckedPort) -> None:
    for word in ("id", *READS):
        if len((reply := line.ask(word)).split()) != N_VALUES[word]:
            raise Deviation(f"{word!r} was answered {reply!r}; expected {N_VALUES[word]} numbers")
    for request in ("D,5,5", "drive 1", "drive a b", "look 1", "lamp 1 2 64"):
        line.expect(request, "-1")


@check("a wheel turns at the speed that is set", "assumed", moves="turns in place for 0.5 s")
def speeds(line: CheckedPort) -> None:
    line.expect("drive 200 -200", "0")
    line.sleep(0.5)
    if (speed := int(line.ask("wheels").split()[0])) not in range(180, 220):
        raise Deviation(f"the left wheel turns at {speed / 100} rad/s; expected 2")
    line.expect("drive 0 0", "0")


CHECKS = Catalogue((reads, speeds))
