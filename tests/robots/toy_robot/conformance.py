"""Checks of a Toy at a port."""

from khep_twin.lab.conformance.port.check import Catalogue, CheckedPort, Deviation, check


@check("an unknown command is answered with a question mark", "assumed")
def unknown_commands(line: CheckedPort) -> None:
    for request in ("X", "M", "M,1", "R,0001", "M,zz,00"):
        line.expect(request, "?")


@check("a wheel turns at the speed that M sets", "assumed", moves="turns in place for 0.5 s")
def speeds(line: CheckedPort) -> None:
    line.order("M,0032,ffce", pause=0.5)
    values = line.ask("R").split(",")[1:]
    line.order("M,0000,0000")
    if (turned := int(values[11], 16)) not in range(40, 60):
        raise Deviation(f"'M,0032,ffce' gave a speed of {turned} mm/s; expected 50")


CHECKS = Catalogue((unknown_commands, speeds))
