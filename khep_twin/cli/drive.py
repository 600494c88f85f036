"""`khep-twin drive`: manual driving of a robot or a twin, by the keys of a terminal."""

import os
import select
import signal
import sys
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from khep_twin.cli.completion import ports
from khep_twin.cli.options import Force, check_new
from khep_twin.errors import KhepTwinError
from khep_twin.process.signals import register_cleanup, stopping

if TYPE_CHECKING:
    import curses

    from khep_twin.lab.experiment.teleoperation import Teleoperation

_REDRAW_MS = 50
"""Interval at which the screen is redrawn between keys [ms]."""

_CTRL_C, _ESCAPE = 3, 27


def drive(
    port: Annotated[
        str, typer.Argument(help="Port of a robot or a twin, such as khep://obstacles.", autocompletion=ports)
    ],
    speed: Annotated[
        int,
        typer.Option(
            min=1, max=40, help="Initial speed [steps: a Khepera's 8 mm/s, 1/20 of the top speed of tasks]."
        ),
    ] = 5,
    baudrate: Annotated[
        int, typer.Option(min=0, help="Baud rate of the line; by default all rates of the robots are tried.")
    ] = 0,
    log: Annotated[
        Path | None, typer.Option(help="Record the drive in this MCAP file; only for a twin at khep://.")
    ] = None,
    force: Force = False,
) -> None:
    """Drive a robot by the terminal's keys, and show its sensors.

    Arrows or WASD drive while held, space stops, + - and 1 to 9 choose the speed, L switches the LEDs, q
    quits. The motors stop at most 0.7 s after the last key, and when the command ends.
    """
    from khep_twin.host.connection import connect
    from khep_twin.lab.experiment.teleoperation import TIMEOUT, Teleoperation

    check_new(force, log)
    if not (sys.stdin.isatty() and sys.stdout.isatty()):
        raise KhepTwinError("drive: there is no terminal to drive from; expected a start in one")
    with (
        stopping(awaited=None) as stop,
        connect(_url_with_log(port, log), TIMEOUT, baudrate) as robot,
    ):
        operation = Teleoperation(robot, speed)
        name, quit_event = f"{port}  {robot.model.title}", threading.Event()
        with ThreadPoolExecutor(1) as pool:
            thread = pool.submit(operation.run, lambda: quit_event.is_set() or stop())
            try:
                _run_on_screen(lambda window: _drive(window, operation, name, thread.done))
            finally:
                quit_event.set()
        thread.result()  # raises its error
        is_stopped = stop()
    typer.echo("the motors were stopped")
    if log is not None:
        typer.echo(f"log      {log}")
    if is_stopped:
        raise typer.Exit(130)


def _url_with_log(port: str, log: Path | None) -> str:
    """Return the port's URL with the log as an option."""
    from urllib.parse import quote

    from khep_twin.host.opening import resolve_port

    if log is None:
        return port
    port = resolve_port(port)
    if not port.startswith("khep://"):
        raise KhepTwinError(
            f"--log {log}: is for a twin at khep://; expected serve --log, or serve --relay {port} --log"
        )
    return f"{port}{'&' if '?' in port else '?'}log={quote(str(log))}"


def _run_on_screen(function: Callable[["curses.window"], None]) -> None:
    """Run a function on the terminal's screen, and restore the screen afterwards."""
    if sys.platform == "win32":
        raise KhepTwinError("drive needs a terminal of Unix; expected the page of khep-twin design")
    import curses

    # Ctrl-Z has no effect, as a suspended process could not hold the dead-man's switch.
    previous_handler = signal.signal(signal.SIGTSTP, signal.SIG_IGN)
    os.environ.setdefault("ESCDELAY", "25")
    unregister = register_cleanup(curses.endwin)
    try:
        curses.setupterm()
        curses.wrapper(function)
    except curses.error as error:
        terminal = os.environ.get("TERM", "")
        raise KhepTwinError(
            f"TERM={terminal}: this terminal cannot be drawn on ({error}); expected TERM=xterm"
        ) from None
    finally:
        unregister()
        signal.signal(signal.SIGTSTP, previous_handler)


def _drive(window: "curses.window", operation: "Teleoperation", name: str, ended: Callable[[], bool]) -> None:
    """Apply keys and draw the robot's state, until q, or until the drive has ended or the terminal closed."""
    import curses

    from khep_twin.lab.experiment.teleoperation import draw

    # In raw mode Ctrl-S cannot block the screen, nor Ctrl-C interrupt an exchange.
    curses.raw()
    with suppress(curses.error):  # a terminal that cannot hide its cursor
        curses.curs_set(0)
    window.timeout(_REDRAW_MS)
    has_hung_up = _make_hang_up_check()
    while not ended() and not has_hung_up():
        key = window.getch()
        window.nodelay(True)
        while key != -1:
            if key in (_CTRL_C, ord("q"), ord("Q")):
                return
            _apply_key(operation, _read_arrow(window) if key == _ESCAPE else key)
            key = window.getch()
        window.timeout(_REDRAW_MS)
        height, width = window.getmaxyx()
        window.erase()
        for row, line in enumerate(draw(operation.state, name, width, height)):
            window.addstr(row, 0, line)
        window.refresh()


def _read_arrow(window: "curses.window") -> int:
    """Return the arrow key of an escape sequence that differs from TERM's; 0 for other sequences."""
    import curses

    arrows = {"A": curses.KEY_UP, "B": curses.KEY_DOWN, "C": curses.KEY_RIGHT, "D": curses.KEY_LEFT}
    if window.getch() not in (ord("["), ord("O")):
        return 0
    letter = window.getch()
    return arrows.get(chr(letter), 0) if 0 < letter < 128 else 0


def _apply_key(operation: "Teleoperation", key: int) -> None:
    """Drive, set the speed or switch the LEDs by a key, a code of curses; ignore other keys."""
    import curses

    from khep_twin.lab.experiment.teleoperation import Direction

    arrows = {curses.KEY_UP: "w", curses.KEY_LEFT: "a", curses.KEY_DOWN: "s", curses.KEY_RIGHT: "d"}
    directions = {"w": Direction.FORWARD, "a": Direction.LEFT, "s": Direction.BACK, "d": Direction.RIGHT}
    letter = chr(key).lower() if key < 128 else arrows.get(key, "")
    if letter in directions:
        operation.press(directions[letter])
    elif letter == " ":
        operation.press(Direction.STOP)
    elif letter in ("+", "-"):
        operation.set_speed(operation.state.speed + (1 if letter == "+" else -1))
    elif "1" <= letter <= "9":
        operation.set_speed(int(letter))
    elif letter == "l":
        operation.switch_leds()


def _make_hang_up_check() -> Callable[[], bool]:
    """Return a function that returns whether the terminal has been closed."""
    if sys.platform == "win32":
        return lambda: False
    poll = select.poll()
    poll.register(sys.stdin.fileno(), select.POLLHUP)
    return lambda: bool(poll.poll(0))
