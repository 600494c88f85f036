"""Checks of the syntax of lines and replies, with the robot at rest."""

from string import ascii_uppercase

from khep_twin.firmware import ARGUMENT_COUNTS
from khep_twin.lab.conformance.port.check import CheckedPort, Deviation, check


@check("a command may end in LF, CR or CR LF, and CR LF is one ending", "3.2, A")
def line_endings(line: CheckedPort) -> None:
    for end in ("\n", "\r", "\r\n"):
        line.send("B" + end)
        answer = line.reply("B")
        if not answer.startswith("b,"):
            raise Deviation(f"{'B' + end!r} was answered {answer!r}")
        line.expect_silence(f"after the reply to {'B' + end!r}")


@check("an empty line gets no reply", "3.2")
def empty_lines(line: CheckedPort) -> None:
    line.send("\n\r\n\r")
    line.expect_silence("after empty lines")


@check("bytes sent one at a time make up a line", "3.2")
def single_bytes(line: CheckedPort) -> None:
    for byte in "G,12,-34\n":
        line.send(byte)
        line.sleep(0.002)
    if (answer := line.reply("G,12,-34")) != "g":
        raise Deviation(f"'G,12,-34' was answered {answer!r}; expected 'g'")


@check("a burst of seven commands is answered in order", "3.2")
def burst(line: CheckedPort) -> None:
    line.send("E\nH\nN\nO\nK\nB\nE\n")
    heads = "".join(line.reply("a command of a burst").split(",")[0] for _ in range(7))
    if heads != "ehnokbe":
        raise Deviation(f"E H N O K B E was answered in the order {' '.join(heads)}")


@check("an unknown command is answered with Command not found", "3.2")
def unknown_words(line: CheckedPort) -> None:
    unused = sorted(set(ascii_uppercase) - {*ARGUMENT_COUNTS, "T"})
    for word in ("hello", "d,5,5", "n", "b", "XY", " ", "  ", "\x01", "?", "x" * 65, *unused):
        line.expect(word, "Command not found")


@check("missing, surplus or wrong parameters are a protocol error", "A")
def wrong_parameters(line: CheckedPort) -> None:
    requests = "D D,1 D,1,2,3 D,a,b D,, C,1 G,1 A,1,2 F,1,2 P,1 J,20,64 J,1,2,3 I L,0 R W,1 N,1 T"
    for request in requests.split():
        line.expect(request, "z,Protocol error")


@check("numbers may carry a sign and leading zeros", "A", at_rest=True)
def signed_numbers(line: CheckedPort) -> None:
    line.order("G,+5,-005")
    if (numbers := line.numbers("H", 2)) != [5, -5]:
        raise Deviation(f"G,+5,-005 set the counters to {numbers}")


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
    if (numbers := line.numbers("H", 2)) != [1, 2]:
        raise Deviation(f"after rubbish H gave {numbers}; expected [1, 2]")
