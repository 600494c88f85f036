"""Checks of the syntax of lines and replies, with the robot at rest."""

from string import ascii_uppercase

from khep_twin.firmware import ARGUMENT_COUNTS
from khep_twin.lab.conformance.port.check import CheckedPort, Deviation, check, replies
from khep_twin.lab.conformance.port.letters import line_endings, single_bytes

_UNUSED = sorted({*ascii_uppercase} - {*ARGUMENT_COUNTS, "T"})
_WRONG = "D D,1 D,1,2,3 D,a,b D,, C,1 G,1 A,1,2 F,1,2 P,1 J,20,64 J,1,2,3 I L,0 R W,1 N,1 T"


endings = line_endings("3.2, A", r"b,\d+\.\d+,\d+\.\d+")
line_of_bytes = single_bytes("3.2", "G,12,-34")


@check("a burst of seven commands is answered in order", "3.2")
def burst(line: CheckedPort) -> None:
    line.send("E\nH\nN\nO\nK\nB\nE\n")
    heads = "".join(line.reply("a command of a burst").split(",")[0] for _ in range(7))
    if heads != "ehnokbe":
        raise Deviation(f"E H N O K B E was answered in the order {' '.join(heads)}")


unknown_words = replies(
    "an unknown command is answered with Command not found",
    "3.2",
    ("Command not found", "hello", "d,5,5", "n", "b", "XY", " ", "  ", "\x01", "?", "x" * 65, *_UNUSED),
)
wrong_parameters = replies(
    "missing, surplus or wrong parameters are a protocol error", "A", ("z,Protocol error", *_WRONG.split())
)
signed_numbers = replies(
    "numbers may carry a sign and leading zeros", "A", "G,+5,-005", ("h,5,-5", "H"), at_rest=True
)


@check("an over-long line gets one reply and has no other effect", "3.2")
def long_line(line: CheckedPort) -> None:
    line.send("D," + "1" * 600 + "\n")
    line.reply("a line of 602 bytes")
    line.expect_silence("after the answer to an over-long line")
    line.order("G,3,4")


@check("commands work again after rubbish", "3.2", at_rest=True)
def binary_rubbish(line: CheckedPort) -> None:
    line.send(bytes(byte for byte in range(256) if byte not in b"\r\n").decode("latin-1") + "\n")
    line.reply("binary rubbish")
    line.order("G,1,2")
    line.expect("H", "h,1,2")
