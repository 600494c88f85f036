"""The BIOS tools: lower-case words on the serial line, beside the protocol's commands (manual, 3.2).

Of their replies only the banner is known; the texts of the other replies are assumed.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from khep_twin.board.protocol import COMMAND_NOT_FOUND, END, Tool, refusal
from khep_twin.board.rom import BAUD_RATES, DEMO, SELF_TEST, Rom
from khep_twin.board.turrets import TurretKind


@dataclass(frozen=True, slots=True)
class ToolContext:
    """State of a board that the tools report.

    Attributes:
        rom: Version of the firmware.
        running: Name of the running ROM function; empty for none.
        turrets: Turrets on the robot.
        commands: Descriptions of the protocol's commands, as printed by `help` and `list`.
    """

    rom: Rom
    running: str
    turrets: tuple[TurretKind, ...]
    commands: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class ToolResult:
    """Reply and effects of a tool.

    Attributes:
        reply: Reply on the line.
        restart: True if the board is reset.
        baud: Baud rate of the line after the reply; 0 if it stays the same.
        function: Name of the ROM function to start; empty for none.
    """

    reply: bytes = b""
    restart: bool = False
    baud: int = 0
    function: str = ""


def _format_lines(*lines: str) -> bytes:
    return b"".join(line.encode("ascii", "backslashreplace") + END for line in lines)


def _help(arguments: tuple[str, ...], context: ToolContext) -> ToolResult:
    if not arguments:
        tools, commands = f"tools     {' '.join(_TOOLS)}", f"commands  {' '.join(context.commands)}"
        return ToolResult(_format_lines("help NAME tells more of a tool or command", tools, commands))
    name = arguments[0]
    description = context.commands.get(name) or (_TOOLS[name][0] if name in _TOOLS else "")
    return ToolResult(_format_lines(f"{name}  {description}") if description else refusal("No such item"))


def _list(arguments: tuple[str, ...], context: ToolContext) -> ToolResult:
    tools = [f"TO  {name:8}  {text}  {context.rom.bios}" for name, (text, _) in _TOOLS.items()]
    functions = [f"FU  {name:8}  ROM function  {context.rom.bios}" for name in (DEMO, SELF_TEST)]
    commands = [f"PR  {name:8}  {text}  {context.rom.protocol}" for name, text in context.commands.items()]
    return ToolResult(_format_lines(*tools, *functions, *commands))


def _net(arguments: tuple[str, ...], context: ToolContext) -> ToolResult:
    turrets = [
        f"{kind.number}  {kind.name}  {kind.description}  revision {kind.revision}"
        for kind in context.turrets
    ]
    return ToolResult(_format_lines(*(turrets or ["no intelligent turret"])))


def _memory(arguments: tuple[str, ...], context: ToolContext) -> ToolResult:
    return ToolResult(_format_lines(f"RAM  {context.rom.memory} bytes", "used by loaded programs  0 bytes"))


def _process(arguments: tuple[str, ...], context: ToolContext) -> ToolResult:
    processes = ["serial communication protocol", "motor controllers", "sensor scan"]
    return ToolResult(_format_lines(*processes, *([context.running] if context.running else [])))


def _run(arguments: tuple[str, ...], context: ToolContext) -> ToolResult:
    if arguments == (DEMO,):
        return ToolResult(_format_lines(f"run {DEMO}"), function=DEMO)
    if arguments == (SELF_TEST,):
        return ToolResult(function=SELF_TEST)
    if arguments == ("sloader",):
        return _NO_LOADER
    return ToolResult(refusal(f"Function not found, right is {DEMO} or {SELF_TEST}"))


def _serial(arguments: tuple[str, ...], context: ToolContext) -> ToolResult:
    baud_rates = {str(baud): baud for baud in BAUD_RATES}
    if len(arguments) != 1 or arguments[0] not in baud_rates:
        return ToolResult(refusal(f"Baud rate not possible, right is one of {' '.join(baud_rates)}"))
    return ToolResult(_format_lines(f"serial {arguments[0]}"), baud=baud_rates[arguments[0]])


_AUTHORS = ToolResult(_format_lines("Edoardo Franzi", "Andre Guignard", "Francesco Mondada"))
_NO_LOADER = ToolResult(refusal("No S-record loader, the twin runs no machine code"))

_Handler = Callable[[tuple[str, ...], ToolContext], ToolResult]
_TOOLS: dict[str, tuple[str, ToolResult | _Handler]] = {
    "help": ("shows what a tool or command does", _help),
    "k-team": ("shows the members of K-Team", _AUTHORS),
    "list": ("shows all modules of the ROM", _list),
    "memory": ("shows the use of the memory", _memory),
    "net": ("shows the intelligent turrets", _net),
    "process": ("shows what is running", _process),
    "restart": ("resets the robot", ToolResult(restart=True)),
    "run": ("starts a function of the ROM", _run),
    "serial": ("sets the speed of the serial line", _serial),
    "sfill": ("loads a program in S-records", _NO_LOADER),
}
"""Description of each tool, and its result or function, by its word."""


def run_tool(tool: Tool, context: ToolContext) -> ToolResult:
    """Execute a tool and return its reply and effects."""
    _, result = _TOOLS.get(tool.word.decode("ascii"), ("", ToolResult(COMMAND_NOT_FOUND)))
    if isinstance(result, ToolResult):
        return result
    return result(tuple(argument.decode("latin-1") for argument in tool.arguments), context)


def self_test(are_sensors_alive: bool) -> bytes:
    """Return the report of running mode 7, the board's self-test."""
    return _format_lines(
        "Self test",
        f"sensors     {'ok' if are_sensors_alive else 'no conversion'}",
        "registers   ok",
        "end of test",
    )
