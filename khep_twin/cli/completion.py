"""Completions for the shell, and choices in messages about missing arguments."""

import os
import re
import warnings
from collections.abc import Callable
from contextlib import redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

from khep_twin.errors import KhepTwinError, choices
from khep_twin.robots.registry import installed_models

Completion = tuple[str, str]
"""Completed value and its description."""

_MAX_CHOICES = 30
"""Longest list of choices in a message."""


def playpens() -> list[Completion]:
    """Return the shipped playpens and the TOML files of the current folder."""
    from khep_twin.files.toml_files import names

    return [(name, summary(name)) for name in names("playpens")] + _local_files(".toml")


def challenges() -> list[Completion]:
    """Return the shipped challenges and the TOML files of the current folder."""
    from khep_twin.files.toml_files import names

    return [(name, "") for name in names("challenges")] + _local_files(".toml")


def calibrations() -> list[Completion]:
    """Return the shipped calibrations and the TOML files of the current folder."""
    from khep_twin.files.toml_files import names

    usual = (model.calibration_name for model in installed_models().values())
    return [(name, "") for name in dict.fromkeys((*names("calibration"), *usual))] + _local_files(".toml")


def controllers() -> list[Completion]:
    """Return the built-in controllers, and the Python files and networks of the current folder."""
    from khep_twin.lab.experiment.controllers import BUILT_IN

    return [(name, "built in") for name in BUILT_IN] + _local_files(".py") + _local_files(".npz")


def models() -> list[Completion]:
    """Return the models of robots."""
    return [(name, model.title) for name, model in installed_models().items()]


def ports() -> list[Completion]:
    """Return the ports of this machine, and the URLs of twins in this process."""
    from khep_twin.files.toml_files import names
    from khep_twin.host.discovery import found_ports

    try:
        completions = [(port.url, port.description) for port in found_ports()]
    except KhepTwinError:  # the folder of services belongs to another user
        completions = []
    return completions + [(f"khep://{name}", summary(name)) for name in names("playpens")]


def logs() -> list[Completion]:
    """Return the logs of the current folder."""
    return _local_files(".mcap")


def studies() -> list[Completion]:
    """Return the TOML files of the current folder."""
    return _local_files(".toml")


def summary(playpen: str) -> str:
    """Return a one-line summary of a shipped playpen."""
    from khep_twin.files import toml_files

    return toml_files.summary("playpens", playpen)


def explain_error(error: Any, text: str) -> str:
    """Return the message of a usage error of typer, with the expected alternatives."""
    if text.startswith("Missing "):
        return _missing_message(error)
    if text.startswith("Got unexpected extra argument"):
        return _surplus_message(error, text)
    context = getattr(error, "ctx", None)
    lacks_hint = text.startswith("No such option") and "Possible" not in text
    if context is not None and (lacks_hint or text.startswith(("Invalid value", "Option "))):
        return f"{text.rstrip('.')}; see {context.command_path} --help"
    return text


def _missing_message(error: Any) -> str:
    """Return the message about a missing argument or option, with its choices."""
    parameter = error.param
    values = [item.value for item in parameter.shell_complete(error.ctx, "")]
    text = f"Missing {parameter.param_type_name} {parameter.get_error_hint()}: {parameter.help or ''}".strip()
    if not values:
        return text
    ellipsis = ["..."] if len(values) > _MAX_CHOICES else []
    return f"{text} {choices('', values[:_MAX_CHOICES] + ellipsis)}"


def _surplus_message(error: Any, text: str) -> str:
    """Return the message about a surplus argument, with the option that is probably missing before it."""
    options = [parameter for parameter in error.ctx.command.params if parameter.param_type_name == "option"]
    word = re.sub(r".*\((\S*).*\)", r"\1", text, flags=re.DOTALL)
    option_name = {".toml": "playpen", ".mcap": "log", ".py": "controller"}.get(Path(word).suffix, "playpen")
    for name in ("output", *((option_name,) if Path(word).suffix or word in dict(playpens()) else ())):
        for option in options:
            if option.name == name:
                return f"{text}; expected {min(option.opts, key=len)} {word}"
    usage = " ".join(error.ctx.command.collect_usage_pieces(error.ctx))
    path = error.ctx.command_path
    return f"{text}; expected {path} {usage}, see {path} --help"


def complete_in_bash(complete: Callable[[], object]) -> None:
    """Print bash's completions of a word with colons, e.g. khep://default.

    Bash splits words at each colon: this function rejoins them, and omits the part of the completed word
    before its last colon from the answer. `complete` prints the completions of the words in the environment.
    """
    words, index = _rejoin_at_colons(os.environ["COMP_WORDS"].split("\n"), int(os.environ["COMP_CWORD"]))
    os.environ["COMP_WORDS"], os.environ["COMP_CWORD"] = "\n".join(words), str(index)
    word = words[index] if index < len(words) else ""
    output = StringIO()
    try:
        with redirect_stdout(output), warnings.catch_warnings(action="ignore"):
            complete()
    finally:
        prefix = word.rpartition(":")[0]
        for line in output.getvalue().splitlines():
            print(line.removeprefix(f"{prefix}:") if prefix else line)


def _rejoin_at_colons(words: list[str], index: int) -> tuple[list[str], int]:
    """Return the words rejoined at colons, and the new index of the word at `index`."""
    joined: list[str] = []
    new_index = index
    for position, word in enumerate(words):
        if joined and (word.startswith(":") or joined[-1].endswith(":")):
            joined[-1] += word
            new_index -= position <= index
        else:
            joined.append(word)
    return joined, new_index


def _local_files(suffix: str) -> list[Completion]:
    """Return the files of the current folder with a suffix; the shell completes other paths."""
    return [(path.name, "") for path in sorted(Path().glob(f"*{suffix}"))]
