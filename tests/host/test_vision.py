"""`Vision`: a K213 by its messages, on a twin and on lines that garble them."""

from collections.abc import Iterator

import numpy as np
import pytest

from khep_twin.board.k213 import PIXELS, K213Register
from khep_twin.errors import ProtocolError
from khep_twin.host import Khepera, Vision, commands
from khep_twin.host.vision import read_image, read_light, read_region
from khep_twin.playpen import Playpen
from khep_twin.ports.protocol_khep import Serial
from khep_twin.ports.twin import Twin, TwinOptions, open_twin


@pytest.fixture
def pair() -> Iterator[tuple[Khepera, Twin]]:
    twin = open_twin(Playpen.load("stripes"), TwinOptions(noise=False))
    with Khepera(Serial.of(twin, timeout=1)) as robot:
        robot.sleep(0.3)
        yield robot, twin


def state(twin: Twin) -> np.ndarray:
    return next(iter(twin.robot.firmware.turrets.values())).registers


def test_every_read_is_a_part_of_the_image(pair: tuple[Khepera, Twin]) -> None:
    robot, twin = pair
    vision = Vision(robot)
    greys = state(twin)[PIXELS].tolist()
    assert vision.versions() == ("1", "0")
    assert list(vision.image()) == greys
    assert np.array(vision.image(), np.uint8).tolist() == greys
    assert list(vision.region(5, 8)) == greys[5:13]
    assert list(vision.region(48, 16)) == greys[48:]
    assert list(vision.coarse()) == [grey // 16 * 16 for grey in greys]
    assert list(vision.every_second()) == greys[::2]
    assert list(vision.every_fourth()) == greys[::4]
    assert (vision.brightest(), vision.darkest()) == (int(np.argmax(greys)), int(np.argmin(greys)))
    assert vision.light() == state(twin)[K213Register.LIGHT] > 0


def test_the_period_is_set(pair: tuple[Khepera, Twin]) -> None:
    robot, twin = pair
    vision = Vision(robot)
    vision.set_period(7)
    assert state(twin)[K213Register.SCAN] == 500
    vision.set_period(0)
    assert state(twin)[K213Register.SCAN] == 20


@pytest.mark.parametrize("period", [-1, 8])
def test_there_are_eight_periods(pair: tuple[Khepera, Twin], period: int) -> None:
    with pytest.raises(ValueError, match=rf"^period {period}; expected 0 to 7$"):
        Vision(pair[0]).set_period(period)


@pytest.mark.parametrize(("start", "count"), [(-1, 8), (57, 8), (49, 16), (0, 12)])
def test_a_region_lies_within_the_image(start: int, count: int) -> None:
    with pytest.raises(ValueError, match=rf"^{count} pixels from {start} on; expected 8 from 0 to 56"):
        read_region(start, count)


def test_reads_go_into_a_burst(pair: tuple[Khepera, Twin]) -> None:
    robot, twin = pair
    image, light, proximity = robot.burst(read_image(), read_light(), commands.proximity())
    assert list(image) == state(twin)[PIXELS].tolist()
    assert light == state(twin)[K213Register.LIGHT]
    assert len(proximity) == 8


def test_a_robot_without_a_k213_is_refused() -> None:
    with Khepera("khep://default") as robot, pytest.raises(ProtocolError):
        Vision(robot)


@pytest.mark.parametrize(
    "reply",
    [
        "t,2,n,1,2",
        "t,2,m" + ",1" * 64,
        "t,1,n" + ",1" * 64,
        "t,2,n" + ",256" * 64,
        "t,2,n" + ",-1" * 64,
        "t,2,n" + ",1" * 65,
        "z,Protocol error",
        "",
    ],
)
def test_a_wrong_reply_is_refused(reply: str) -> None:
    with pytest.raises(ValueError, match="expected"):
        read_image().read(reply)


def test_reads_may_be_sent_again_and_orders_may_not() -> None:
    assert read_image().repeatable
    assert read_light().repeatable
    assert read_region(0, 8).repeatable


@pytest.mark.parametrize("mode", [1, 2, 3])
def test_a_long_reply_takes_the_time_of_its_bytes_on_the_line(mode: int) -> None:
    baud = {1: 9600, 2: 19200, 3: 38400}[mode]
    mine = Playpen.load("stripes")
    robots = (mine.robots[0].model_copy(update={"mode": mode}),)
    twin = open_twin(mine.model_copy(update={"robots": robots}), TwinOptions(noise=False))
    with Khepera(Serial.of(twin, timeout=1), baudrate=baud) as robot:
        robot.sleep(0.3)
        for request in ("T,2,N", "T,2,R,0", "T,2,O"):
            start = robot.time
            reply = robot.ask(request)
            n_bytes = len(request) + 1 + len(reply) + 2
            assert robot.time - start == pytest.approx(n_bytes * 11 / baud, abs=1e-4)
