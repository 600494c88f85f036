"""What is burnt into the robot's ROM and set by its jumpers: versions of the firmware and running modes.

Running modes are chosen by three jumpers on the Khepera 1 (0 to 7) and by a wheel on the Khepera II (0 to F);
the board reads them at a reset (manual, appendix E; manual II, appendix C).
"""

from collections.abc import Mapping
from dataclasses import dataclass

DEMO = "demo"
"""Name of the Braitenberg demonstration among the ROM's functions."""

SELF_TEST = "test"
"""Name of the self-test among the ROM's functions."""

BAUD_RATES = (1200, 2400, 4800, 9600, 19200, 38400, 57600, 115200)
"""Speeds that the tool `serial` sets (assumed: the usual ones up to what any host asks for)."""


@dataclass(frozen=True, slots=True)
class Rom:
    """What differs between versions of the firmware.

    Attributes:
        bios: version of the BIOS, the first field of the reply to B.
        protocol: version of the serial protocol, the second.
        banner: lines shown after a reset.
        mode_codes: how command K names speed, position and PWM mode.
    """

    bios: str
    protocol: str
    banner: tuple[str, ...]
    mode_codes: tuple[int, int, int]


ROMS: Mapping[str, Rom] = {
    # Banner and versions as in K-Team's FAQ; its line breaks are a guess.
    "5.02": Rom(
        bios="5.02",
        protocol="5.01",
        banner=(
            "ROM of minirobot KHEPERA, Edoardo Franzi",
            "K-Team S.A.",
            "October 22, 1998 Rev. 5.01",
            "Serial Communication Protocol",
        ),
        mode_codes=(0, 1, 2),
    ),
    # The mode codes are those of the toolbox's reference to the manual 4.06; the rest is assumed.
    "4.06": Rom(
        bios="4.06",
        protocol="4.06",
        banner=("ROM of minirobot KHEPERA, Edoardo Franzi", "Rev. 4.06", "Serial Communication Protocol"),
        mode_codes=(1, 0, 2),
    ),
}


@dataclass(frozen=True, slots=True)
class RunningMode:
    """What the robot does after a reset.

    Attributes:
        baud: speed of the serial line.
        function: of the ROM that is started, besides the protocol; empty for none.
        refusal: why the twin cannot do it; empty if it can.
    """

    baud: int = 9600
    function: str = ""
    refusal: str = ""


_LOADER = "waits for a program in S-records, and the twin runs no machine code"
_USER = "runs a user's program from the robot's memory, and the twin runs no machine code"
_SECOND = "is a mode of the Khepera II, which is not modelled"

MODES: Mapping[int, RunningMode] = {
    0: RunningMode(function=DEMO),
    1: RunningMode(9600),
    2: RunningMode(19200),
    3: RunningMode(38400),
    4: RunningMode(refusal=_USER),
    5: RunningMode(refusal=_LOADER),
    6: RunningMode(refusal=_LOADER),
    7: RunningMode(function=SELF_TEST),
    **{mode: RunningMode(refusal=_SECOND) for mode in range(8, 16)},
}
"""All running modes. In modes 0 and 7 the twin answers the protocol, too (assumed)."""

MODES_WISH = (
    f"a running mode that the twin has ({', '.join(str(m) for m, mode in MODES.items() if not mode.refusal)})"
)
"""What a running mode must be, in words."""


def refused(mode: int) -> str:
    """Why a running mode cannot be had; empty if it can."""
    if mode not in MODES:
        return f"there is no such mode; right is {MODES_WISH}"
    refusal = MODES[mode].refusal
    return f"mode {mode:X} {refusal}; right is {MODES_WISH}" if refusal else ""
