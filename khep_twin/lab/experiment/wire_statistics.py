"""Statistics of a serial line: commands, replies and reply times."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from khep_twin.log.channels import TextLine
from khep_twin.robots.framing import LINES, Framing

_REFUSALS = ("z,", "Command not found")


@dataclass(frozen=True, slots=True)
class Wire:
    """Statistics of a serial line's transcript.

    Attributes:
        commands: Number of commands by letter or word, in descending order.
        replies: Number of replies.
        refused: Number of refusals among the replies.
        unanswered: Number of commands without a reply, except tools, which print several lines.
        mean_s: Mean time from a command's end to its reply's end [s]; 0 without replies.
        longest_s: Longest time from a command's end to its reply's end [s].
    """

    commands: Mapping[str, int]
    replies: int
    refused: int
    unanswered: int
    mean_s: float
    longest_s: float

    @property
    def count(self) -> int:
        """Number of all commands."""
        return sum(self.commands.values())


def wire(lines: Sequence[TextLine], framing: Framing = LINES) -> Wire:
    """Return a transcript's statistics; a reply belongs to the oldest pending command that it answers."""
    commands: Counter[str] = Counter()
    open_commands: list[tuple[str, int]] = []
    delays_ns: list[int] = []
    refused = unanswered = 0
    for line in lines:
        if line.name == "host":
            # A command's letter or a tool's word.
            commands[framing.command(line.text) or "?"] += 1
            if framing.has_one_reply(line.text):
                open_commands.append((line.text, line.time_ns))
            continue
        is_refusal = line.text.startswith(_REFUSALS)
        answered = (
            index
            for index, (request, _) in enumerate(open_commands)
            if is_refusal or framing.answers(request, line.text)
        )
        # A refusal answers the oldest command; commands before an answered one stay unanswered.
        if (command_index := next(answered, None)) is None:
            continue
        delays_ns.append(line.time_ns - open_commands[command_index][1])
        refused += is_refusal
        unanswered += command_index
        del open_commands[: command_index + 1]
    unanswered += len(open_commands)
    mean_s = sum(delays_ns) / len(delays_ns) / 1e9 if delays_ns else 0.0
    sorted_commands = dict(sorted(commands.items(), key=lambda item: (-item[1], item[0])))
    return Wire(sorted_commands, len(delays_ns), refused, unanswered, mean_s, max(delays_ns, default=0) / 1e9)
