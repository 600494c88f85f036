"""Versions of the firmware in the robot's ROM, and running modes.

Running modes are chosen by three jumpers on the Khepera 1 (0 to 7) and by a wheel on the Khepera II (0 to F);
the board reads them at a reset (manual, appendix E; manual II, appendix C).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

DEMO = "demo"
"""Name of the Braitenberg demonstration among the ROM's functions."""

SELF_TEST = "test"
"""Name of the self-test among the ROM's functions."""

SELF_TEST_MODE = 7
"""Running mode of the self-test."""

BAUD_RATES = (1200, 2400, 4800, 9600, 19200, 38400, 57600, 115200)
"""Baud rates that the tool `serial` sets (assumed: the usual ones of hosts)."""


@dataclass(frozen=True, slots=True)
class RunningMode:
    """Behaviour of the robot after a reset.

    Attributes:
        baud: Baud rate of the serial line.
        function: ROM function that is started beside the protocol; empty for none.
        refusal: Reason why the twin cannot run it; empty if it can.
    """

    baud: int = 9600
    function: str = ""
    refusal: str = ""


_LOADER = "waits for a program in S-records, and the twin runs no machine code"
_USER = "runs a user's program from the robot's memory, and the twin runs no machine code"
_SERVICE = "rewrites the robot's memory, and the twin runs no machine code"
_KHEPERA_2_ONLY = "is a mode of the Khepera II; the twin has it with rom khepera2"
_RESERVED = "is reserved"

_COMMON_MODES: Mapping[int, RunningMode] = {
    0: RunningMode(function=DEMO),
    1: RunningMode(9600),
    2: RunningMode(19200),
    3: RunningMode(38400),
    4: RunningMode(refusal=_USER),
    5: RunningMode(refusal=_LOADER),
    6: RunningMode(refusal=_LOADER),
    SELF_TEST_MODE: RunningMode(function=SELF_TEST),
}
"""Modes of both robots. In modes 0 and 7 the twin also answers the protocol (assumed)."""

KHEPERA_1_MODES: Mapping[int, RunningMode] = {
    **_COMMON_MODES,
    **{mode: RunningMode(refusal=_KHEPERA_2_ONLY) for mode in range(8, 16)},
}
"""Modes of the Khepera 1, which has three jumpers; modes 8 to 15 only refer to the Khepera II."""

KHEPERA_2_MODES: Mapping[int, RunningMode] = {
    **_COMMON_MODES,
    8: RunningMode(57600),
    9: RunningMode(115200),
    10: RunningMode(refusal=_LOADER),
    11: RunningMode(refusal=_USER),
    12: RunningMode(refusal=_RESERVED),
    13: RunningMode(refusal=_RESERVED),
    14: RunningMode(refusal=_SERVICE),
    15: RunningMode(refusal=_SERVICE),
}


@dataclass(frozen=True, slots=True)
class Rom:
    """One version of the firmware.

    Attributes:
        bios: Version of the BIOS, the first field of the reply to B.
        protocol: Version of the serial protocol, the second field.
        banner: Lines sent after a reset.
        mode_codes: Codes of speed, position and PWM mode in the reply to K.
        memory: Size of the RAM [bytes] (manual and manual II, specification).
        modes: Running modes by number.
    """

    bios: str
    protocol: str
    banner: tuple[str, ...]
    mode_codes: tuple[int, int, int] = (0, 1, 2)
    memory: int = 256 * 1024
    modes: Mapping[int, RunningMode] = field(default_factory=lambda: KHEPERA_1_MODES)

    def refusal_reason(self, mode: int) -> str:
        """Return the reason why a running mode is unavailable; empty if it is available."""
        codes = ", ".join(f"{number:X}" for number, entry in self.modes.items() if not entry.refusal)
        expected = f"a running mode that the twin has ({codes})"
        if mode not in self.modes:
            return f"there is no such mode; expected {expected}"
        refusal = self.modes[mode].refusal
        return f"mode {mode:X} {refusal}; expected {expected}" if refusal else ""

    def find_mode(self, baud: int) -> int | None:
        """Find the running mode that only runs the protocol, at this baud rate; None without one."""
        protocol_mode = RunningMode(baud)
        return next((number for number, mode in self.modes.items() if mode == protocol_mode), None)


_AUTHOR = "ROM of minirobot KHEPERA, Edoardo Franzi"
_PROTOCOL = "Serial Communication Protocol"

ROMS: Mapping[str, Rom] = {
    # Banner and versions as in K-Team's FAQ; its line breaks are a guess.
    "5.02": Rom(
        bios="5.02", protocol="5.01", banner=(_AUTHOR, "K-Team S.A.", "October 22, 1998 Rev. 5.01", _PROTOCOL)
    ),
    # The mode codes are from the toolbox's reference to the manual 4.06; the rest is assumed.
    "4.06": Rom(bios="4.06", protocol="4.06", banner=(_AUTHOR, "Rev. 4.06", _PROTOCOL), mode_codes=(1, 0, 2)),
    # Modes and memory: manual II. No source gives its version numbers or its banner: assumed.
    "khepera2": Rom(
        bios="6.01",
        protocol="5.01",
        banner=(_AUTHOR, "K-Team S.A.", "Khepera II Rev. 6.01", _PROTOCOL),
        memory=512 * 1024,
        modes=KHEPERA_2_MODES,
    ),
}
