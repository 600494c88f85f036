"""Checks of the syntax of a Khepera IV's lines and replies, with the robot at rest."""

import re

from khep_twin.lab.conformance.port.check import CheckedPort, Deviation, check

REVISION = re.compile(r"b,[A-P],(0|[1-9]\d?)")
"""Reply to B."""

PUBLISHED = "server"
"""Section of checks of the published program that are not in the manual."""


def expect_refused(line: CheckedPort, *requests: str) -> None:
    """Raise a `Deviation` unless each request is answered by "$"."""
    for request in requests:
        line.expect(request, "$")


@check("a command may end in LF, CR or CR LF, and CR LF is one ending", PUBLISHED)
def line_endings(line: CheckedPort) -> None:
    for end in ("\n", "\r", "\r\n"):
        line.send("B" + end)
        answer = line.reply("B")
        if not REVISION.fullmatch(answer):
            raise Deviation(f"{'B' + end!r} was answered {answer!r}; expected a reply such as 'b,B,0'")
        line.expect_silence(f"after the reply to {'B' + end!r}")


@check("an empty line gets no reply", PUBLISHED)
def empty_lines(line: CheckedPort) -> None:
    line.send("\n\r\n\r")
    line.expect_silence("after empty lines")


@check("bytes sent one at a time make up a line", "6")
def single_bytes(line: CheckedPort) -> None:
    for byte in "P,20\n":
        line.send(byte)
        line.sleep(0.002)
    if (answer := line.reply("P,20")) != "p":
        raise Deviation(f"'P,20' was answered {answer!r}; expected 'p'")


@check("bytes sent after a command are lost until its reply", PUBLISHED)
def pipelining(line: CheckedPort) -> None:
    line.send("B\nE\nE\n")
    if not REVISION.fullmatch(answer := line.reply("B")):
        raise Deviation(f"'B' was answered {answer!r}; expected a reply such as 'b,B,0'")
    line.expect_silence("after the reply to the first of three commands sent together")


@check("an unknown command is answered with $", "6")
def unknown_commands(line: CheckedPort) -> None:
    expect_refused(line, "C", "C,1,1", "Q", "W", "Y", "b", "n", "hello", " ", " B", "0", "?", "$", ",")


@check("numbers are parsed as in C, and empty ones are skipped", PUBLISHED)
def numbers_of_c(line: CheckedPort) -> None:
    status, percentage = line.ask("V,7"), line.ask("V,5")
    for reply, requests in ((status, ("V, 7", "V,+07", "V,7x,", "V,,7", "Vx7")), (percentage, ("V,65541",))):
        for request in requests:
            line.expect(request, reply)


@check("only the first 82 bytes of a long line count, and it gets one reply", PUBLISHED)
def long_line(line: CheckedPort) -> None:
    line.send("K," + "0,,,,,,,," * 8 + ",,,,,,,0,1,1,1\n")
    if (answer := line.reply("K")) != "k":
        raise Deviation(f"nine numbers in 82 bytes, and three after them, gave {answer!r}; expected 'k'")
    line.expect_silence("after the reply to a long line")


@check("commands work again after rubbish", PUBLISHED)
def rubbish(line: CheckedPort) -> None:
    expect_refused(line, bytes(range(ord(" "), 127)).decode())
    line.order("P,20")
