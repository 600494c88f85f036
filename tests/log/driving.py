"""A short run: commands, one every tenth of a second."""

from khep_twin.ports.twin import Twin

SECOND = 1_000_000_000
COMMANDS = (b"D,8,5\n", b"N\n", b"O\n")


def drive(twin: Twin, seconds: int = 2) -> None:
    """Sends commands, one every tenth of a second."""
    for tenth in range(10 * seconds):
        twin.robot.send(COMMANDS[tenth % len(COMMANDS)])
        twin.advance_to((tenth + 1) * SECOND // 10)
