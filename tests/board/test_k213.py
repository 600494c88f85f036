"""The K213's electronics: orders, replies and the rate of its scans."""

import numpy as np
import pytest

from khep_twin.board.k213 import PIXELS, K213Electronics, K213Register

GREYS = [(7 * pixel + 11) % 251 for pixel in range(64)]


@pytest.fixture
def k213() -> K213Electronics:
    turret = K213Electronics()
    turret.registers[PIXELS] = GREYS
    turret.registers[K213Register.LIGHT] = 258
    return turret


def listed(letter: str, values: list[int]) -> str:
    return ",".join(["t,2", letter, *map(str, values)])


@pytest.mark.parametrize(
    ("order", "reply"),
    [
        ("B", "t,2,b,1,0"),
        ("L", "t,2,l,1,2"),
        ("M", listed("m", [GREYS[k] // 16 * 16 + GREYS[k + 1] // 16 for k in range(0, 64, 2)])),
        ("N", listed("n", GREYS)),
        ("O", listed("o", [int(np.argmax(GREYS))])),
        ("P", listed("p", [int(np.argmin(GREYS))])),
        ("Q,0", listed("q", GREYS[:8])),
        ("Q,56", listed("q", GREYS[56:])),
        ("R,3", listed("r", GREYS[3:19])),
        ("R,48", listed("r", GREYS[48:])),
        ("S", listed("s", GREYS[::2])),
        ("T", listed("t", GREYS[::4])),
        ("U,0", "t,2,u"),
        ("U,7", "t,2,u"),
        *((order, "z,Protocol error") for order in ("Q", "Q,57", "Q,-1", "Q,x", "R,49", "R,1,2")),
        *((order, "z,Protocol error") for order in ("N,1", "L,0", "U", "U,8", "U,-1")),
        *((order, "z,Turret order not supported") for order in ("V", "n", "\xff")),
    ],
)
def test_every_order_gets_its_reply(k213: K213Electronics, order: str, reply: str) -> None:
    assert k213.receive(order.encode("latin-1")) == reply.encode() + b"\r\n"


def test_of_equal_pixels_the_leftmost_is_brightest_and_darkest(k213: K213Electronics) -> None:
    k213.registers[PIXELS] = 9
    assert k213.receive(b"O") == b"t,2,o,0\r\n"
    assert k213.receive(b"P") == b"t,2,p,0\r\n"


def test_a_wrong_order_changes_nothing(k213: K213Electronics) -> None:
    before = k213.registers.tolist()
    for order in (b"U,8", b"Q,57", b"N,0", b"V"):
        k213.receive(order)
    assert k213.registers.tolist() == before


def ticks_of_a_scan(k213: K213Electronics) -> int:
    scans = k213.registers[K213Register.SCANS]
    for ticks in range(1, 1000):
        k213.tick()
        if k213.registers[K213Register.SCANS] > scans:
            return ticks
    raise AssertionError("no scan has ended")


def test_the_first_scan_ends_at_once(k213: K213Electronics) -> None:
    assert ticks_of_a_scan(k213) == 1


@pytest.mark.parametrize(
    ("light", "ticks"), [(1, 5), (50, 5), (200, 20), (258, 26), (999, 100), (65535, 100)]
)
def test_a_scan_by_the_light_takes_as_many_milliseconds_as_the_sensor_reads(
    k213: K213Electronics, light: int, ticks: int
) -> None:
    k213.registers[K213Register.LIGHT] = light
    ticks_of_a_scan(k213)
    assert ticks_of_a_scan(k213) == ticks


@pytest.mark.parametrize(
    ("period", "ticks"), [(1, 5), (2, 10), (3, 15), (4, 25), (5, 50), (6, 100), (7, 500)]
)
def test_a_fixed_period_begins_with_its_order(k213: K213Electronics, period: int, ticks: int) -> None:
    ticks_of_a_scan(k213)
    k213.receive(b"U,%d" % period)
    assert [ticks_of_a_scan(k213) for _ in range(2)] == [ticks, ticks]


def test_a_reset_scans_by_the_light_again_and_keeps_the_image(k213: K213Electronics) -> None:
    k213.receive(b"U,7")
    k213.reset()
    assert ticks_of_a_scan(k213) == 1
    assert ticks_of_a_scan(k213) == 26
    assert k213.registers[PIXELS].tolist() == GREYS
