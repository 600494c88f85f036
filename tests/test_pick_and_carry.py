"""Picking up, carrying and putting down, through the serial protocol alone: bytes out, bytes in."""

import math

import mujoco
import numpy as np
import pytest
import serial

import khep_twin  # noqa: F401  (teaches pyserial khep://)

HALF_TURN = 1021  # pulses


class Host:
    """A program of 1996: it writes lines and reads lines."""

    def __init__(self, url: str) -> None:
        self.port = serial.serial_for_url(url, baudrate=9600, stopbits=2, timeout=1)

    def ask(self, line: str) -> list[int]:
        self.port.write(line.encode() + b"\r\n")
        letter, *values = self.port.readline().decode().strip().split(",")
        assert letter == line[0].lower(), (line, letter, values)
        return [int(value) for value in values if value.isdigit()]

    def until_still(self) -> None:
        before: list[list[int]] = []
        while (now := [self.ask("T,1,H,0"), self.ask("T,1,H,1")]) != before:
            before = now
            self.port.sleep(0.1)

    def drive(self, left: int, right: int) -> None:
        self.ask(f"C,{left},{right}")
        while sum(self.ask("K")[::3]) < 2:
            pass


def truth(host: Host) -> tuple[np.ndarray, float]:
    """Place of the first cylinder [m] and how upright it stands."""
    world = host.port.twin.world
    mujoco.mj_kinematics(world.model, world.data)
    body = world.data.body("cylinder0")
    return body.xpos.copy(), float(body.xmat[8])


@pytest.mark.share(3)
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_a_cylinder_is_found_picked_up_carried_and_put_down(seed: int) -> None:
    host = Host(f"khep://gripper?seed={seed}")
    start = truth(host)[0]
    assert host.ask("T,1,B") == [1, 1, 0]
    host.ask("D,5,5")
    while max(host.ask("N")[2:4]) < 400:
        pass
    host.ask("D,0,0")
    host.ask("T,1,E,255")
    host.until_still()
    host.ask("D,2,2")
    while host.ask("T,1,G")[1] < 200:
        pass
    host.ask("D,0,0")
    assert host.ask("T,1,F") == [1, 255]
    host.ask("T,1,D,1")
    host.until_still()
    assert 80 <= host.ask("T,1,H,0")[1] <= 92  # half a gap of 12.5 mm
    host.ask("T,1,E,152")
    host.until_still()
    lifted = truth(host)[0]
    assert lifted[2] > 0.06

    host.ask("G,0,0")
    host.drive(-HALF_TURN, HALF_TURN)
    host.drive(-HALF_TURN + 1500, HALF_TURN + 1500)
    carried = truth(host)[0]
    assert carried[2] > 0.06
    assert math.dist(carried[:2], lifted[:2]) > 0.1

    host.ask("T,1,E,255")
    host.until_still()
    host.ask("T,1,D,0")
    host.until_still()
    host.ask("D,-5,-5")
    host.port.sleep(1)
    host.ask("D,0,0")
    end, upright = truth(host)
    assert upright > 0.999
    assert end[2] == pytest.approx(0.02, abs=0.0005)
    assert math.dist(end, start) > 0.15
    assert host.ask("T,1,G") == [1, 0]
    # It stays where it was put.
    host.port.sleep(5)
    assert math.dist(truth(host)[0], end) < 0.0005
    host.port.close()
