"""Turrets: how they are found and plugged on."""

from collections.abc import Iterator
from dataclasses import replace
from importlib.metadata import EntryPoint, EntryPoints

import numpy as np
import pytest

from khep_twin.board import turrets
from khep_twin.board.gripper_body import GRIPPER
from khep_twin.board.protocol import turret_reply
from khep_twin.board.rom import ROMS
from khep_twin.board.turrets import TurretKind, find_turrets, installed_turrets, mount_heights
from khep_twin.errors import TurretError
from khep_twin.firmware import Firmware
from khep_twin.playpen import Playpen
from khep_twin.playpen_to_mjcf import to_spec


class Radio:
    """A turret without a body: counts its messages, and the ticks since its reset."""

    def __init__(self) -> None:
        self.registers = np.zeros(2, np.int64)

    def receive(self, message: bytes) -> bytes:
        self.registers[0] += 1
        return turret_reply(4, "S", message.decode(), int(self.registers[0]))

    def tick(self) -> None:
        self.registers[1] += 1

    def reset(self) -> None:
        self.registers[1] = 0


RADIO = TurretKind("radio", 4, "counts messages", "0.1", Radio)
SECOND = TurretKind("second", 4, "has the same number", "0.1", Radio)
MAST = TurretKind("mast", 24, "has nothing on it", "0.1", Radio, height=None)
ARM = TurretKind("arm", 25, "reaches the floor", "0.1", Radio, height=0.01, is_lowest=True)
BOARD = TurretKind("board", 26, "stands anywhere", "0.1", Radio, height=0.02)
BEYOND = TurretKind("beyond", 32, "has a number that the bus has not", "0.1", Radio)
NOTHING = 5


@pytest.fixture
def offered(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[str]]:
    """Names in this file that packages offer as turrets, for a test to fill."""
    names: list[str] = []

    def entry_points(group: str) -> EntryPoints:
        assert group == "khep_twin.turrets"
        return EntryPoints(
            EntryPoint(name.lower().split("=")[0], f"{__name__}:{name.split('=')[-1]}", group)
            for name in names
        )

    monkeypatch.setattr(turrets, "entry_points", entry_points)
    installed_turrets.cache_clear()
    yield names
    installed_turrets.cache_clear()


def test_the_gripper_comes_with_the_twin() -> None:
    (kind,) = find_turrets(["gripper"])
    assert (kind.name, kind.number) == ("gripper", 1)
    assert kind.scene is not None
    assert kind.scene.exists()


def test_any_package_may_offer_a_turret(offered: list[str]) -> None:
    offered += ["RADIO"]
    assert find_turrets(["radio"]) == (RADIO,)


@pytest.mark.parametrize(
    ("names", "line"),
    [
        (
            ["radoi"],
            "unknown turret 'radoi'; did you mean 'radio'? (choices: arm, board, radio, second, mast)",
        ),
        (["radio", "second"], "turret 'second' and 'radio' are both number 4"),
        (["board", "arm"], "turret 'arm' fits only right on the robot; expected it first"),
        (["mast", "board"], "nothing fits on turret 'mast'; expected it last, not below 'board'"),
    ],
)
def test_turrets_that_cannot_be_plugged_on_are_one_line(
    offered: list[str], names: list[str], line: str
) -> None:
    offered += ["RADIO", "SECOND", "MAST", "BOARD", "ARM"]
    with pytest.raises(TurretError) as caught:
        find_turrets(names)
    assert str(caught.value) == line


def test_each_turret_of_a_stack_is_raised_by_those_below_it(offered: list[str]) -> None:
    offered += ["MAST", "BOARD", "ARM", "RADIO"]
    assert list(installed_turrets()) == ["arm", "board", "radio", "mast"]
    assert mount_heights(find_turrets(["arm", "board", "mast"])) == pytest.approx((0, 0.01, 0.03))
    # One without a body and a height has no place in the stack.
    assert mount_heights(find_turrets(["radio", "arm"])) == (0, 0)
    assert mount_heights(find_turrets(["mast", "radio"])) == (0, 0)


def test_the_body_of_a_turret_stands_on_the_one_below_it(
    offered: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    lens = replace(MAST, name="lens", scene=GRIPPER.scene)
    monkeypatch.setitem(globals(), "LENS", lens)
    offered += ["GRIPPER", "LENS"]
    scene = Playpen.load("gripper")
    robot = scene.robots[0].model_copy(update={"turrets": ("gripper", "lens")})
    model = to_spec(scene.model_copy(update={"robots": (robot,)})).compile()
    lower, upper = (model.body(f"khepera0/{name}/board").pos for name in ("gripper", "lens"))
    assert (upper - lower).tolist() == pytest.approx([0, 0, 0.008])
    alone = to_spec(scene).compile().body("khepera0/gripper/board").pos
    assert lower.tolist() == alone.tolist()


@pytest.mark.parametrize(
    ("names", "part"),
    [
        (["MISSING"], ":MISSING cannot be loaded"),
        (["NOTHING"], ":NOTHING is 5; expected a TurretKind"),
        (["BEYOND"], "expected a TurretKind with a number from 0 to 31"),
        (["other=RADIO"], "has name = 'radio'; expected 'other', the name of its entry point"),
    ],
)
def test_a_package_that_offers_no_turret_is_named(offered: list[str], names: list[str], part: str) -> None:
    offered += names
    with pytest.raises(TurretError) as caught:
        installed_turrets()
    assert part in str(caught.value)
    assert "\n" not in str(caught.value)


def test_the_board_passes_messages_ticks_and_resets_on() -> None:
    radio = Radio()
    firmware = Firmware(ROMS["5.02"], 1, {RADIO: radio})
    assert firmware.receive(b"T,4,S,hello\nT,4,x\nT,5,S\nT,4\n") == (
        b"t,4,s,S,hello,1\r\nt,4,s,x,2\r\nz,Turret order not supported\r\nz,Protocol error\r\n"
    )
    firmware.tick(0, 0)
    firmware.tick(0, 0)
    assert radio.registers.tolist() == [2, 2]
    firmware.receive(b"restart\n")
    assert radio.registers.tolist() == [2, 0]
