"""A second, simple model of the board's replies to compare the firmware with, without lines and physics.

It is written from docs/protocol.md, not from the firmware. For values that depend on a profile in progress
(the position error, and when the target is reached) it only checks conditions.
"""

from dataclasses import dataclass, field

SPEED, POSITION, PWM = 0, 1, 2
ERROR, UNKNOWN, NO_ORDER = "z,Protocol error", "Command not found", "z,Turret order not supported"
COUNTS = dict(A=3, B=0, C=2, D=2, E=0, F=3, G=2, H=0, I=1, J=4, K=0, L=2, N=0, O=0, P=2, R=1, W=2)
WEIGHTS = [(4, -5), (4, -15), (6, -18), (-18, 6), (-15, 4), (-5, 4), (5, 3), (3, 5)]
BANNER = [
    "ROM of minirobot KHEPERA, Edoardo Franzi",
    "K-Team S.A.",
    "October 22, 1998 Rev. 5.01",
    "Serial Communication Protocol",
]


def clip(value: int, letter_out: int, high: int) -> int:
    """Clip a value to a range."""
    return sorted((letter_out, value, high))[1]


def in_32_bits(value: int) -> int:
    """Wrap a value to a signed 32-bit number."""
    return int.from_bytes((value & 0xFFFFFFFF).to_bytes(4, "big"), "big", signed=True)


@dataclass
class WheelModel:
    """State of one wheel on the board."""

    position: int = 0
    speed: int = 0
    mode: int = SPEED
    setpoint: int = 0
    target: int = 0
    error: int = 0
    on_target: int = 1

    def turn(self, pulses: int) -> None:
        """Run a tick in which the encoder counts some pulses."""
        self.position = in_32_bits(self.position + pulses)
        self.speed = pulses
        if self.mode == SPEED:
            self.error = self.setpoint - pulses

    def run(self, mode: int, value: int) -> None:
        """Set a new mode and setpoint."""
        if mode == SPEED:
            self.setpoint = value
        elif mode == POSITION:
            self.target = value
        if mode == PWM or mode != self.mode:
            self.error = 0
        self.mode, self.on_target = mode, 0

    def status_fits(self, on_target: int, mode: int, error: int) -> bool:
        """Return whether the wheel's part of a reply to K is right."""
        if mode != self.mode:
            return False
        if mode != POSITION:
            return (on_target, error) == (self.on_target, self.error)
        is_near = abs(in_32_bits(self.target - self.position)) <= 2
        return on_target in (0, 1) and (not on_target or (is_near and abs(error) <= 2))


@dataclass
class BoardModel:
    """State of the board with a gripper."""

    wheels: tuple[WheelModel, WheelModel] = field(default_factory=lambda: (WheelModel(), WheelModel()))
    proximity: list[int] = field(default_factory=lambda: [0] * 8)
    ambient: list[int] = field(default_factory=lambda: [0] * 8)
    scan: int = 0
    supply: tuple[int, int] = (0, 0)
    demo: bool = False
    baud: int = 9600
    arm_target: int = 152

    def convert(self, proximity: int, ambient: int) -> None:
        """Store one sensor of the scan."""
        self.proximity[self.scan], self.ambient[self.scan] = proximity, ambient
        self.scan = (self.scan + 1) % 8

    def tick(self, left: int, right: int) -> None:
        """Run a control period."""
        for wheel, pulses in zip(self.wheels, (left, right), strict=True):
            wheel.turn(pulses)
        if self.demo and self.scan == 0:
            for side, wheel in enumerate(self.wheels):
                drive = sum(w[side] * n for w, n in zip(WEIGHTS, self.proximity, strict=True))
                wheel.run(SPEED, int(drive / 400) + 10)

    def reset(self) -> None:
        """Reset all except measured values."""
        self.wheels = (WheelModel(), WheelModel())
        self.demo, self.baud = False, 9600

    def answer(self, letter: str, values: list[int]) -> str | None:
        """Return the reply to a well-formed command; None if `status_fits` must check it."""
        letter_out = letter.lower()
        left, right = self.wheels
        if len(values) != COUNTS[letter]:
            return ERROR
        match letter:
            case "B":
                return "b,5.02,5.01"
            case "C" | "D" | "P":
                limit, mode = {"C": (2**23 - 2, POSITION), "D": (127, SPEED), "P": (255, PWM)}[letter]
                for wheel, value in zip(self.wheels, values, strict=True):
                    wheel.run(mode, clip(value, -limit, limit))
            case "E":
                return f"e,{left.speed},{right.speed}"
            case "G":
                for wheel, value in zip(self.wheels, values, strict=True):
                    position = in_32_bits(value)
                    wheel.target += position - wheel.position
                    wheel.position = position
            case "H":
                return f"h,{left.position},{right.position}"
            case "I":
                last = self.scan - 1
                channels = [self.supply[0], self.proximity[last], self.ambient[last], 0, 0, 0, self.supply[1]]
                return f"i,{channels[values[0]]}" if 0 <= values[0] < 7 else ERROR
            case "K":
                return None
            case "L":
                return "l" if values[0] in (0, 1) and values[1] in (0, 1, 2) else ERROR
            case "N" | "O":
                return ",".join([letter_out, *map(str, self.proximity if letter == "N" else self.ambient)])
            case "R":
                return "r,255" if 0 <= values[0] < 64 else ERROR
            case "W":
                return "w" if 0 <= values[0] < 256 and 0 <= values[1] < 64 else ERROR
            case _:
                pass
        return letter_out

    def status_fits(self, reply: str) -> bool:
        """Return whether a reply to K is right; adopt its flags of reached targets."""
        letter, *fields = reply.split(",")
        numbers = [int(value) for value in fields]
        if letter != "k" or len(numbers) != 6:
            return False
        fits = True
        for wheel, part in zip(self.wheels, (numbers[:3], numbers[3:]), strict=True):
            fits = fits and wheel.status_fits(part[0], part[1], part[2])
            if wheel.mode == POSITION:
                wheel.on_target = part[0]
        return fits

    def turret(self, number: int, letter: str, values: list[int]) -> str:
        """Return the reply to a message to a turret; the gripper's body does not move."""
        counts = dict(B=0, D=1, E=1, F=0, G=0, H=1, J=0)
        if number != 1 or letter not in counts:
            return NO_ORDER
        if len(values) != counts[letter] or (letter in "DH" and values[0] not in (0, 1)):
            return ERROR
        replies = {"B": ",1,0", "F": ",255", "G": ",0", "J": ",0"}
        if letter == "H":
            return f"t,1,h,{152 if values[0] else 200}"
        if letter == "E":
            self.arm_target = clip(values[0], 152, 255)
        return f"t,1,{letter.lower()}{replies.get(letter, '')}"
