"""Checks of a Toy at a port."""

from khep_twin.lab.conformance.port.check import Catalogue, CheckedPort, Deviation, check
from toy_robot.model import FRAMES, REGISTERS, SPEEDS, frame, values


@check("an unknown command and a wrong checksum get no reply", "assumed")
def unknown_frames(line: CheckedPort) -> None:
    for data in (b"R\r\n", frame(9), frame(SPEEDS, 1), frame(REGISTERS)[:-1] + b"\0"):
        line.send(data + FRAMES.resync)
        line.expect_silence(f"after {data.hex()}")


@check("a wheel turns at the speed that is set", "assumed", moves="turns in place for 0.5 s")
def speeds(line: CheckedPort) -> None:
    line.ask(FRAMES.decode(frame(SPEEDS, 50, -50)))
    line.sleep(0.5)
    if (speed := values(bytes.fromhex(line.ask(FRAMES.decode(frame(REGISTERS)))))[11]) not in range(40, 60):
        raise Deviation(f"the left wheel turns at {speed} mm/s; expected 50")


CHECKS = Catalogue((unknown_frames, speeds))
