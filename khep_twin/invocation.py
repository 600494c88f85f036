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
            program by it, else its path.
    """
    return f"{shlex.quote(_found(program))} {shlex.join(map(str, words))}".rstrip()


def _found(name: str) -> str:
    typed, own = Path(sys.argv[0]), Path(sys.executable).with_name(name)
    script = typed if typed.name == name and typed.is_file() else own
    known = shutil.which(name)
    if not script.is_file() or (known is not None and os.path.samefile(known, script)):
        return name
    # A link is not resolved, as it belongs to this environment.
    path, here = Path(os.path.abspath(script)), Path.cwd()
    if not path.is_relative_to(here):
        return str(path)
    below = path.relative_to(here)
    return str(below) if below.parent.name else f"./{below}"
