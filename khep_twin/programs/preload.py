"""The preload library and the compiler options for programs of robots, and the folders of both."""

import contextlib
import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Generator
from pathlib import Path

from khep_twin.errors import KhepTwinError

COMPILERS = "cc", "gcc", "clang"
"""C compilers; the first that is installed is used. CC in the environment names another."""

SOURCES = Path(__file__).parent / "assets"
"""Folder of the preload library; `include` has headers for K-Team's libraries that this computer may lack."""

TEMPORARY_FOLDERS = "/tmp", "/var/tmp", "/dev/shm"
"""Folders for temporary files if the path of the usual one is unusable."""

ORPHANS_S = 0.3
"""Time of the wall clock until children without a twin are killed [s]; most end on their own."""

_WATCHDOG = f"""
read -r line && exit
sleep {ORPHANS_S}
for file in /proc/[0-9]*/environ; do
    grep -qsF "$1" "$file" && file="${{file#/proc/}}" && kill -9 "${{file%/environ}}"
done
rm -rf "$1"
"""
"""Program of the shell that ends at a line; at the end of its input, as this process was killed, it kills the
processes whose environment has a folder, and removes the folder."""

_MAX_FOLDER = 60  # characters, as the path of a socket has up to 107
_LIST_SEPARATORS = frozenset(" :")  # at which the loader splits LD_PRELOAD
_SHELL_CHARACTERS = frozenset(" \t\n*?[]{}()<>\"'\\$`&|;#~!")


def find_temporary_folder() -> str:
    """Return a folder for sockets and for the link to the preload library.

    Raises:
        KhepTwinError: No folder can be written whose path a socket and LD_PRELOAD accept.
    """
    usual_folder = tempfile.gettempdir()
    for folder in (usual_folder, *TEMPORARY_FOLDERS):
        if len(folder) <= _MAX_FOLDER and not _LIST_SEPARATORS & {*folder} and os.access(folder, os.W_OK):
            return folder
    raise KhepTwinError(
        f"{usual_folder}: unusable for sockets; expected a folder in TMPDIR that can be written, with a path "
        f"of up to {_MAX_FOLDER} characters without spaces and colons"
    )


@contextlib.contextmanager
def watched_folder() -> Generator[str, None, None]:
    """Make a folder for sockets and files, which is removed even if this process is killed."""
    with tempfile.TemporaryDirectory(prefix="khep-twin-", dir=find_temporary_folder()) as folder:
        null, command = subprocess.DEVNULL, ["/bin/sh", "-c", _WATCHDOG, "sh", folder]
        with subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=null, stderr=null, start_new_session=True
        ) as watchdog:
            try:
                yield folder
            finally:
                watchdog.communicate(b"\n")


def compiler_flags() -> list[str]:
    """Return the options of `cc` for K-Team's libraries and their programs.

    The libraries store pointers in 32 bits and define variables in their headers; the robots' `char` is
    unsigned. No option has a character that a shell treats specially, as a shell splits the options.

    Raises:
        KhepTwinError: No path of the headers is free of these characters.
    """
    flags = ["-fcommon", "-funsigned-char", "-fno-pie", "-no-pie", "-idirafter"]
    headers = SOURCES / "include"
    if not _SHELL_CHARACTERS & {*str(headers)}:
        return [*flags, str(headers)]
    link = _cache_folder() / f"include-{hashlib.sha256(os.fsencode(headers)).hexdigest()[:14]}"
    if _SHELL_CHARACTERS & {*str(link)}:
        raise KhepTwinError(
            f"{headers}: the path has a character that a shell treats specially, and so has {link.parent}; "
            "expected a cache folder without one (XDG_CACHE_HOME)"
        )
    try:
        link.parent.mkdir(parents=True, exist_ok=True)
        with contextlib.suppress(FileExistsError):
            link.symlink_to(headers)
    except OSError as error:
        raise KhepTwinError(
            f"{link.parent}: {error.strerror}; expected a cache folder that can be written (XDG_CACHE_HOME)"
        ) from error
    return [*flags, str(link)]


def _cache_folder() -> Path:
    """Return this project's folder in the user's cache folder."""
    try:
        return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache").absolute() / "khep_twin"
    except RuntimeError:
        raise KhepTwinError(
            "no cache folder: this user has no home folder; expected a cache folder in XDG_CACHE_HOME"
        ) from None


def preload_library(bits: int = 64) -> Path:
    """Return the preload library of a word size, 32 or 64 bits, compiled into the user's cache if missing.

    Raises:
        KhepTwinError: This is not Linux, there is no C compiler, or it fails.
    """
    if sys.platform != "linux":
        raise KhepTwinError(f"programs of robots on {sys.platform}; expected Linux")
    cache = _cache_folder()
    sources = sorted(SOURCES.glob("shim*"))
    content = b"".join(source.read_bytes() for source in sources)
    library_path = cache / f"preload-{bits}-{hashlib.sha256(content).hexdigest()[:14]}.so"
    if library_path.exists():
        return library_path
    chosen_compiler = os.environ.get("CC")
    compiler = chosen_compiler or next(filter(None, map(shutil.which, COMPILERS)), None)
    if compiler is None:
        raise KhepTwinError("no C compiler is installed; expected cc, gcc or clang (Debian: apt install gcc)")
    try:
        cache.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=cache) as folder:
            temporary_path = Path(folder, library_path.name)
            c_files = [str(source) for source in sources if source.suffix == ".c"]
            flags = ["-O2", "-shared", "-fPIC", "-U_FORTIFY_SOURCE", *(["-m32"] if bits == 32 else [])]
            compilation = subprocess.run(
                [*compiler.split(), *flags, "-o", str(temporary_path), *c_files, "-ldl", "-lpthread"],
                capture_output=True,
                text=True,
            )
            if compilation.returncode and bits == 32:
                raise KhepTwinError(
                    f"{compiler} cannot compile for 32 bits; "
                    "expected gcc-multilib (Debian: apt install gcc-multilib)"
                )
            if compilation.returncode:
                message = (compilation.stderr.strip().splitlines() or ["no message"])[0]
                raise KhepTwinError(f"{compiler}: cannot compile the preload library: {message}")
            os.replace(temporary_path, library_path)
    except OSError as error:
        raise KhepTwinError(
            f"{error.filename or compiler}: {error.strerror}; expected a C compiler, and a cache "
            "folder that can be written (XDG_CACHE_HOME)"
        ) from error
    return library_path
