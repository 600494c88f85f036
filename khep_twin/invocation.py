"""Commands that a message asks the user to paste into a shell."""

import os
import shlex
import shutil
import sys
from pathlib import Path


def command(*words: object, program: str = "khep-twin") -> str:
    """Return a command line, quoted for the shell, whose program the shell finds.

    Args:
        words: Arguments.
        program: Name of a program of this installation. The bare name is used if the shell finds that
            program by it, otherwise its path.
    """
    return " ".join(quoted(str(word)) for word in (_find_program(program), *words))


def quoted(word: str) -> str:
    """Return a word as a shell takes it; the bytes of a name that is no text are written in octal."""
    try:
        word.encode()
        return shlex.quote(word)
    except UnicodeEncodeError:
        plain = set(range(32, 127)) - set(b"%'\\")
        octal = (chr(byte) if byte in plain else f"\\{byte:03o}" for byte in os.fsencode(word))
        return f"\"$(printf '{''.join(octal)}')\""


def _find_program(name: str) -> str:
    typed, installed = Path(sys.argv[0]), Path(sys.executable).with_name(name)
    script = typed if typed.name == name and typed.is_file() else installed
    shell_path = shutil.which(name)
    if not script.is_file() or (shell_path is not None and os.path.samefile(shell_path, script)):
        return name
    # A link is not resolved, as it belongs to this environment.
    path, folder = Path(os.path.abspath(script)), Path.cwd()
    if not path.is_relative_to(folder):
        return str(path)
    below = path.relative_to(folder)
    return str(below) if below.parent.name else f"./{below}"
