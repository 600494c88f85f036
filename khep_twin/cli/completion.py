"""Completions for the shell, and choices for a message about a missing argument."""

import os
import re
from collections.abc import Callable
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

from khep_twin.errors import KhepTwinError, choices

Offer = tuple[str, str]
"""Value and its description."""

_MOST_CHOICES = 30
"""Longest list of choices in a message."""


def playpens() -> list[Offer]:
    """Return the shipped playpens and the TOML files of the current folder."""
    from khep_twin.files.toml_files import names

    return [(name, summary(name)) for name in names("playpens")] + _files(".toml")


def challenges() -> list[Offer]:
    """Return the shipped challenges and the TOML files of the current folder."""
    from khep_twin.files.toml_files import names

    return [(name, "") for name in names("challenges")] + _files(".toml")


def calibrations() -> list[Offer]:
    """Return the shipped calibrations and the TOML files of the current folder."""
    from khep_twin.files.toml_files import names

    return [(name, "") for name in names("calibration")] + _files(".toml")


def controllers() -> list[Offer]:
    """Return the built-in controllers, and the Python files and networks of the current folder."""
    from khep_twin.lab.experiment.controllers import BUILT_IN

    return [(name, "built in") for name in BUILT_IN] + _files(".py") + _files(".npz")


def ports() -> list[Offer]:
    """Return the ports that robots and twins may be at, and twins in this process."""
    from khep_twin.files.toml_files import names
    from khep_twin.host.discovery import found_ports

    try:
        found = [(port.url, port.what) for port in found_ports()]
    except KhepTwinError:  # their folder is not this user's
        found = []
    return found + [(f"khep://{name}", summary(name)) for name in names("playpens")]


def logs() -> list[Offer]:
    """Return the logs of the current folder."""
    return _files(".mcap")


def studies() -> list[Offer]:
    """Return the TOML files of the current folder."""
    return _files(".toml")


def summary(playpen: str) -> str:
    """Return what a shipped playpen is, in a line."""
    from khep_twin.files import toml_files

    return toml_files.summary("playpens", playpen)


def explained(error: Any, text: str) -> str:
    """Return the message of typer's error about what was typed, with what could be typed instead."""
    if text.startswith("Missing "):
        return _missing(error)
    if text.startswith("Got unexpected extra argument"):
        return _surplus(error, text)
    context = getattr(error, "ctx", None)
    is_open = text.startswith("No such option") and "Possible" not in text
    if context is not None and (is_open or text.startswith(("Invalid value", "Option "))):
        return f"{text.rstrip('.')}; see {context.command_path} --help"
    return text


def _missing(error: Any) -> str:
    """Return the message about a missing argument or option, with its choices."""
    parameter = error.param
    offers = [item.value for item in parameter.shell_complete(error.ctx, "")]
    told = f"Missing {parameter.param_type_name} {parameter.get_error_hint()}: {parameter.help or ''}".strip()
    if not offers:
        return told
    more = ["..."] if len(offers) > _MOST_CHOICES else []
    return f"{told} {choices('', offers[:_MOST_CHOICES] + more)}"


def _surplus(error: Any, text: str) -> str:
    """Return the message about a surplus argument, with the option that may be meant."""
    options = [each for each in error.ctx.command.params if each.param_type_name == "option"]
    word = re.sub(r".*\((\S*).*\)", r"\1", text, flags=re.DOTALL)
    meant = {".toml": "playpen", ".mcap": "log", ".py": "controller"}.get(Path(word).suffix, "playpen")
    for name in ("output", *((meant,) if Path(word).suffix or word in dict(playpens()) else ())):
        for option in options:
            if option.name == name:
                return f"{text}; expected {min(option.opts, key=len)} {word}"
    usage = " ".join(error.ctx.command.collect_usage_pieces(error.ctx))
    path = error.ctx.command_path
    return f"{text}; expected {path} {usage}, see {path} --help"


def complete_in_bash(complete: Callable[[], object]) -> None:
    """Print bash's completions of a word with colons, such as khep://default.

    Bash splits words at each colon: the words come joined here, and what stands before the last
    colon of the completed one is left out of the answer. `complete` prints the completions of the
    words in the environment.
    """
    words, index = _rejoined(os.environ["COMP_WORDS"].split("\n"), int(os.environ["COMP_CWORD"]))
    os.environ["COMP_WORDS"], os.environ["COMP_CWORD"] = "\n".join(words), str(index)
    word = words[index] if index < len(words) else ""
    shown = StringIO()
    try:
        with redirect_stdout(shown):
            complete()
    finally:
        before = word.rpartition(":")[0]
        for line in shown.getvalue().splitlines():
            print(line.removeprefix(f"{before}:") if before else line)


def _rejoined(words: list[str], index: int) -> tuple[list[str], int]:
    """Return words whose parts at colons are one again, and where the word at `index` is now."""
    joined: list[str] = []
    now = index
    for place, word in enumerate(words):
        if joined and (word.startswith(":") or joined[-1].endswith(":")):
            joined[-1] += word
            now -= place <= index
        else:
            joined.append(word)
    return joined, now


def _files(ending: str) -> list[Offer]:
    """Return the files of the current folder that end so; the shell completes those elsewhere."""
    return [(path.name, "") for path in sorted(Path().glob(f"*{ending}"))]
