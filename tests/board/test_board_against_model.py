"""The firmware agrees with a model of the board on the replies to thousands of random commands.

The suite runs some of them; `KHEP_COMMANDS=50000` runs 50,000 and more, as the part `model` of a night
does, and `KHEP_FIRST=1000` starts with another seed.
"""

import os
from itertools import pairwise
from typing import Any

from board_model import BANNER, COUNTS, ERROR, NO_ORDER, UNKNOWN, BoardModel
from hypothesis import HealthCheck, seed, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, rule, run_state_machine_as_test

from khep_twin.board import kernel
from khep_twin.board.gripper import Register
from khep_twin.board.rom import ROMS
from khep_twin.board.turrets import find_turrets
from khep_twin.firmware import Firmware

COMMANDS_WANTED = int(os.environ.get("KHEP_COMMANDS", "2000"))
FIRST_SEED = int(os.environ.get("KHEP_FIRST", "0"))
SESSIONS_A_SEED = 20

EDGES = [0, 1, 2, 3, 6, 7, 63, 64, 127, 128, 255, 256, 1023, 32767, 32768, 2**23 - 2, 2**23, 2**31 - 1, 2**31]
NUMBERS = st.one_of(
    st.integers(-10, 10),
    st.sampled_from([*EDGES, *(-edge for edge in EDGES)]),
    st.integers(-(2**33) + 1, 2**33 - 1),
)
WORDS = [
    "hello",
    "d,5,5",
    "Q",
    "M",
    "XY",
    "Z,1",
    " ",
    "\t",
    "?",
    "\x01",
    "\xff\xfe",
    "b",
    "1",
    ",",
    "DD,1,1",
    "\xe9",
]
WRONG_FIELDS = ["", "x", "1.5", "0x1", "--1", "+", "1 2", "12345678901", "1e3", "\xb2"]
ENDS = st.sampled_from(["\n", "\r", "\r\n", "\n\n", "\r\n\r\n"])
TOOLS = {
    "serial 19200": ["serial 19200"],
    "serial  38400": ["serial 38400"],
    "run demo": ["run demo"],
    "restart": BANNER,
    "net": ["1  gripper  arm with two fingers  revision 1.0"],
    "sfill": ["z,No S-record loader, the twin runs no machine code"],
    "help D": ["D  set the speed"],
    "nonsense": [UNKNOWN],
}


def format_number(number: int, style: int) -> str:
    """Return a number in one of the formats of hosts."""
    plain = str(number)
    if style == 1 and number >= 0:
        return "+" + plain
    if style == 2 and len(plain) < 6:
        return plain.replace("-", "-00") if number < 0 else "00" + plain
    return f" {plain}" if style == 3 else plain


@st.composite
def lines(draw: st.DrawFn) -> tuple[str, str, Any]:
    """Return a line, its kind and its contents."""
    kind = draw(st.sampled_from(["command"] * 12 + ["turret"] * 3 + ["arity", "field", "word", "tool"]))
    if kind == "word":
        return draw(st.sampled_from(WORDS)), kind, None
    if kind == "tool":
        tool = draw(st.sampled_from(sorted(TOOLS)))
        return tool, kind, tool
    style = draw(st.integers(0, 3))
    if kind == "turret":
        number, letter = draw(st.sampled_from([1, 1, 1, 2, 31])), draw(st.sampled_from("BDEFGHJX"))
        values = draw(st.lists(st.integers(-2, 300), max_size=2))
        text = ",".join([f"T,{number},{letter}", *(format_number(value, style) for value in values)])
        return text, kind, (number, letter, values)
    letter = draw(st.sampled_from(sorted(COUNTS)))
    count = COUNTS[letter] + (draw(st.sampled_from([-1, 1, 2])) if kind == "arity" else 0)
    values = [draw(NUMBERS) for _ in range(max(count, 0))]
    fields = [format_number(value, style) for value in values]
    if kind == "field":
        index = draw(st.integers(0, len(fields)))
        fields[index : index + 1] = [draw(st.sampled_from(WRONG_FIELDS))]
        return ",".join([letter, *fields]), kind, None
    return ",".join([letter, *fields]), "command", (letter, values)


class Session(RuleBasedStateMachine):
    """One host with one board."""

    n_commands = 0

    def __init__(self) -> None:
        super().__init__()
        (kind,) = find_turrets(["gripper"])
        self.gripper = kind.make()
        self.firmware = Firmware(ROMS["5.02"], 1, {kind: self.gripper})
        self.model = BoardModel()
        self.encoders = [0, 0]

    @rule(
        script=st.lists(st.tuples(lines(), ENDS), min_size=4, max_size=24),
        cuts=st.lists(st.integers(0, 200)),
    )
    def say(self, script: list[tuple[tuple[str, str, Any], str]], cuts: list[int]) -> None:
        """Send lines in pieces of any sizes, and compare the replies one by one."""
        data = "".join(line[0] + end for line, end in script).encode("latin-1")
        starts = [0, *sorted(index for index in cuts if index < len(data)), len(data)]
        pieces = pairwise(starts)
        output = b"".join(self.firmware.receive(data[start:end]) for start, end in pieces)
        replies = output.decode("ascii").split("\r\n")
        assert replies.pop() == ""
        for (text, kind, content), _ in script:
            Session.n_commands += 1
            for expected in self.expected(kind, content):
                reply = replies.pop(0)
                if expected is None:
                    assert self.model.status_fits(reply), (text, reply, self.model.wheels)
                else:
                    assert reply == expected, text
        assert not replies
        assert self.firmware.baud == self.model.baud
        assert self.gripper.registers[Register.ARM_TARGET] == self.model.arm_target

    def expected(self, kind: str, content: Any) -> list[str | None]:
        """Return the replies of the model; None for one that it only checks."""
        match kind:
            case "command":
                return [self.model.answer(*content)]
            case "turret":
                return [self.model.turret(*content)]
            case "field":
                return [ERROR]
            case "word":
                return [UNKNOWN]
            case _:
                if content == "restart":
                    self.model.reset()
                    self.model.arm_target = 152
                elif content == "run demo":
                    self.model.demo = True
                elif content.startswith("serial"):
                    self.model.baud = int(content.split()[1])
                return list(TOOLS[content])

    @rule(left=st.integers(-200, 200), right=st.integers(-200, 200), ticks=st.integers(1, 5))
    def turn(self, left: int, right: int, ticks: int) -> None:
        """Turn the wheels, independently of the motors."""
        for _ in range(ticks):
            self.encoders[0] += left
            self.encoders[1] += right
            self.firmware.tick(*self.encoders)
            self.model.tick(left, right)

    @rule(
        counts=st.lists(st.tuples(st.integers(0, 1023), st.integers(0, 1023)), min_size=1, max_size=9),
        supply=st.tuples(st.integers(0, 1023), st.integers(0, 999)),
    )
    def convert(self, counts: list[tuple[int, int]], supply: tuple[int, int]) -> None:
        """Convert some sensors and the supply."""
        for proximity, ambient in counts:
            kernel.convert(self.firmware.register_view, proximity, ambient)
            self.model.convert(proximity, ambient)
        kernel.measure(self.firmware.register_view, *supply)
        self.model.supply = supply


def test_the_firmware_agrees_with_the_model_on_thousands_of_commands() -> None:
    # What hypothesis draws depends on the modules that are loaded, so that only the count tells when to end.
    Session.n_commands, number = 0, FIRST_SEED
    while Session.n_commands < COMMANDS_WANTED:
        before = Session.n_commands
        run_state_machine_as_test(
            seed(number)(Session),
            settings=settings(
                max_examples=SESSIONS_A_SEED,
                stateful_step_count=60,
                deadline=None,
                database=None,
                suppress_health_check=list(HealthCheck),
            ),
        )
        number += 1
        assert Session.n_commands > before
    print(f"{Session.n_commands} commands agree, seeds {FIRST_SEED} to {number - 1}")


def test_the_model_would_notice_a_wrong_reply() -> None:
    model = BoardModel()
    assert model.answer("D", [300, -5]) == "d"
    assert [wheel.setpoint for wheel in model.wheels] == [127, -5]
    assert not model.status_fits("k,1,0,0,1,0,0")
    assert model.status_fits("k,0,0,0,0,0,0")
    assert model.turret(2, "B", []) == NO_ORDER
