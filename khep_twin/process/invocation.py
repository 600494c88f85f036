"""Commands that a message asks the user to paste into a shell."""

import os
import shlex
import shutil
import sys
from pathlib import Path


def command(*words: object, program: str = "khep-twin") -> str:
    """Return a command line, quoted for the shell.

    Args:
        words: Arguments.
        program: Name of a program of this installation. The bare name is used if the shell finds that
            program by it, otherwise its path.
    """
    return " ".join(quoted(str(word)) for word in (_find_program(program), *words))


def quoted(word: str) -> str:
    """Return a word quoted for a shell; the bytes of a file name that is no text are written in octal."""
    try:
        word.encode()
        return shlex.quote(word)
    except UnicodeEncodeError:
        unescaped_bytes = set(range(32, 127)) - set(b"%'\\")
        octal = (chr(byte) if byte in unescaped_bytes else f"\\{byte:03o}" for byte in os.fsencode(word))
        return f"\"$(printf '{''.join(octal)}')\""


def _find_program(name: str) -> str:
    """Return the name by which a shell finds a program of this installation, or else its path."""
    typed, installed = Path(sys.argv[0]), Path(sys.executable).with_name(name)
    script = typed if typed.name == name and typed.is_file() else installed
    shell_path = shutil.which(name)
    if not script.is_file() or (shell_path is not None and os.path.samefile(shell_path, script)):
        return name
    # A link is not resolved, as it belongs to this environment.
    path, folder = Path(os.path.abspath(script)), Path.cwd()
    if not path.is_relative_to(folder):
        return str(path)
    relative_path = path.relative_to(folder)
    return str(relative_path) if relative_path.parent.name else f"./{relative_path}"
