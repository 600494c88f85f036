"""What was said on a serial line, in numbers: commands, replies, and how long they took."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from khep_twin.log.channels import Line

_REFUSALS = ("z,", "Command not found")


@dataclass(frozen=True, slots=True)
class Wire:
    """A serial line's transcript in numbers.

    Attributes:
        commands: how often each was given, by letter or word, the most frequent first.
        replies: how many were answered.
        refused: how many of these with a refusal.
        unanswered: commands without a reply; tools, which answer at length, are not reckoned.
        mean_s: from a command's end to its reply's end [s]; 0 without replies.
        longest_s: likewise.
    """

    commands: Mapping[str, int]
    replies: int
    refused: int
    unanswered: int
    mean_s: float
    longest_s: float

    @property
    def count(self) -> int:
        """Of all commands."""
        return sum(self.commands.values())


def wire(lines: Sequence[Line]) -> Wire:
    """A transcript in numbers; a reply belongs to the oldest open command of its letter.

    Args:
        lines: of host and robot, in order of time.
    """
    commands: Counter[str] = Counter()
    open_commands: list[tuple[str, int]] = []
    took_ns: list[int] = []
    refused = unanswered = 0
    for line in lines:
        if line.name == "host":
            name = _name(line.text)
            commands[name] += 1
            if name.isupper() or not name.isalpha():
                open_commands.append((name[:1].lower(), line.time_ns))
            continue
        refusal = line.text.startswith(_REFUSALS)
        letters = [letter for letter, _ in open_commands]
        # A refusal answers what is next, and commands before the one that is answered stay without.
        place = 0 if refusal and letters else _find(letters, line.text)
        if place is None:
            continue
        took_ns.append(line.time_ns - open_commands[place][1])
        refused += refusal
        unanswered += place
        del open_commands[: place + 1]
    unanswered += len(open_commands)
    mean_s = sum(took_ns) / len(took_ns) / 1e9 if took_ns else 0.0
    ordered = dict(sorted(commands.items(), key=lambda item: (-item[1], item[0])))
    return Wire(ordered, len(took_ns), refused, unanswered, mean_s, max(took_ns, default=0) / 1e9)


def _name(text: str) -> str:
    """A command's letter or a tool's word."""
    head = text.strip().split(",")[0].split(" ")[0]
    return head[:12] or "?"


def _find(letters: list[str], text: str) -> int | None:
    """Which open command a reply is to, None if to none."""
    letter, _, _ = text.partition(",")
    return letters.index(letter) if letter in letters else None
