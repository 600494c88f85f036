"""Executable files: for which computer they were compiled, and obstacles to a preload library in them.

The loader that a dynamic program names in its ELF header (`PT_INTERP`) loads preload libraries. The kernel
starts a static program without a loader, and a loader ignores preload libraries in a program that gains
rights by its file (setuid bit, capabilities). A program that another one starts is checked as well: it is
refused if it contains the name of a device node.
"""

import mmap
import os
import re
import shutil
import stat
import struct
import subprocess
import sys
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from khep_twin.errors import KhepTwinError

PROCESSORS = {3: "x86", 8: "MIPS", 20: "PowerPC", 21: "PowerPC", 22: "s390", 40: "ARM", 62: "x86-64"} | {
    183: "ARM of 64 bits",
    243: "RISC-V",
    258: "LoongArch",
}
"""Names of processors, by `e_machine`."""

_X86, _X86_64 = 3, 62
_OBJECT, _CORE = 1, 4  # e_type
_INTERPRETER = 3  # p_type
_MAX_PATH = 4096
_MAX_SCRIPTS = 5  # a script, its interpreter's script and so on


class Executable(NamedTuple):
    """Header of an ELF file.

    Attributes:
        bits: Word size.
        processor: Number of the processor, `e_machine`.
        kind: Kind of the file, `e_type`.
        loader: Path of its dynamic loader; empty if there is none.
    """

    bits: int
    processor: int
    kind: int
    loader: str


def read_executable(path: str | Path) -> Executable | None:
    """Return the header of an ELF file; None for other files, and those that cannot be read."""
    try:
        with open(path, "rb") as file:
            start = file.read(64)
            if not start.startswith(b"\x7fELF"):
                return None
            order, bits = "<" if start[5] == 1 else ">", 64 if start[4] == 2 else 32
            word, fields, counts, content = ("Q", 32, 54, (8, 32)) if bits == 64 else ("I", 28, 42, (4, 16))
            kind, processor = struct.unpack_from(f"{order}HH", start, 16)
            (table,) = struct.unpack_from(order + word, start, fields)
            size, count = struct.unpack_from(f"{order}HH", start, counts)
            file.seek(table)
            segments = [file.read(size) for _ in range(count)]
            for segment in segments:
                if struct.unpack_from(f"{order}I", segment) == (_INTERPRETER,):
                    offset, length = (struct.unpack_from(order + word, segment, at)[0] for at in content)
                    file.seek(offset)
                    name = file.read(min(length, _MAX_PATH)).rstrip(b"\0")
                    return Executable(bits, processor, kind, os.fsdecode(name))
            return Executable(bits, processor, kind, "")
    except (OSError, OverflowError, IndexError, struct.error):
        return None


def find_executable(program: str) -> Path | None:
    """Return the file that the kernel runs for a program: itself, or its interpreter; None for neither.

    Raises:
        KhepTwinError: The interpreter of a script does not exist.
    """
    name = program
    for _ in range(_MAX_SCRIPTS):
        path = Path(shutil.which(name) or name)
        try:
            with path.open("rb") as file:
                start = file.read(256)
        except (FileNotFoundError, NotADirectoryError):
            if name == program:
                return None
            raise KhepTwinError(
                f"{program}: its interpreter is {name!r}; expected one that is installed"
            ) from None
        except OSError:
            return None
        if not start.startswith(b"#!"):
            return path.absolute()  # for the loader, which searches other names in its folders
        words = os.fsdecode(start[2:].partition(b"\n")[0]).split()
        if words and words[0].endswith("/env"):
            words = [word for word in words[1:] if not word.startswith("-") and "=" not in word] or words
        if not words:
            return None
        name = words[0]
    return None


def check_executable(program: str) -> Executable | None:
    """Return the header of the file that the kernel runs for a program; None if that is no ELF file.

    Raises:
        KhepTwinError: It is known that no preload library can be loaded into it.
    """
    path = find_executable(program)
    executable = None if path is None else read_executable(path)
    if path is None or executable is None:
        return None
    name = (
        program
        if Path(shutil.which(program) or program).absolute() == path
        else f"{program}: its interpreter {path}"
    )
    if executable.kind in (_OBJECT, _CORE):
        raise KhepTwinError(f"{name}: an object file or a core dump; expected a linked program")
    host = read_executable(sys.executable)
    processors = {host.processor, _X86} if host and host.processor == _X86_64 else {host and host.processor}
    if host is not None and executable.processor not in processors:
        processor, expected = (
            PROCESSORS.get(number, f"processor {number}") for number in (executable.processor, host.processor)
        )
        raise KhepTwinError(
            f"{name}: a program for {processor}; expected one for {expected}: compile its source here"
        )
    if not executable.loader:
        raise KhepTwinError(
            f"{name}: a static program, which loads no preload library; expected a dynamic one: "
            "link it without -static"
        )
    if not Path(executable.loader).exists():
        raise KhepTwinError(
            f"{name}: its loader {executable.loader} does not exist; expected a program that was compiled on "
            "this computer"
        )
    if _gains_rights(path):
        raise KhepTwinError(
            f"{name}: its setuid bit, setgid bit or capabilities forbid a preload library; expected a copy "
            "without them (cp)"
        )
    return executable


def _gains_rights(path: Path) -> bool:
    """Return whether a file gives rights to its process that this process lacks."""
    assert sys.platform == "linux"
    try:
        status = path.stat()
        if os.statvfs(path).f_flag & os.ST_NOSUID:
            return False
        attributes = os.listxattr(path) if os.geteuid() else []
    except OSError:
        return False
    is_group_bit = status.st_mode & stat.S_ISGID and status.st_mode & stat.S_IXGRP
    return (
        bool(status.st_mode & stat.S_ISUID and status.st_uid != os.getuid())
        or bool(is_group_bit and status.st_gid != os.getgid())
        or "security.capability" in attributes
    )


def check_preload(program: str, loader: str, library: Path, environment: Mapping[str, str]) -> None:
    """Check that the loader of a program loads a preload library.

    Args:
        program: The program.
        loader: Its dynamic loader, from its header.
        library: The preload library, as in LD_PRELOAD of the environment.
        environment: Environment of the program.

    Raises:
        KhepTwinError: It does not, or it does not find a library of the program.
    """
    path = find_executable(program)
    listing = subprocess.run(
        [loader, "--list", str(path)],
        env=environment,
        stdin=subprocess.DEVNULL,
        capture_output=True,
        text=True,
        errors="replace",
    )
    if missing := re.findall(
        r"(\S+) => not found|: (\S+): cannot open shared object", listing.stdout + listing.stderr
    ):
        names = ", ".join(sorted({first or second for first, second in missing}))
        raise KhepTwinError(f"{program}: needs {names}; expected libraries that are installed")
    if str(library) in listing.stdout:
        return
    reason = re.search(r"preloaded \((.*)\)", listing.stderr)
    raise KhepTwinError(
        f"{program}: {loader} does not load the preload library {library.resolve()} "
        f"({reason[1] if reason else 'without a reason'}); expected a cache folder that may hold programs "
        "(XDG_CACHE_HOME), and the C compiler of the program (CC)"
    )


class StartedPrograms:
    """Checks of the programs that a program and its children start.

    Args:
        first: Header of the first program, whose loader loads the preload library; None if it is unknown.
        library: The preload library, as in LD_PRELOAD of the environment.
        environment: Environment of the first program.
    """

    def __init__(self, first: Executable | None, library: Path, environment: Mapping[str, str]) -> None:
        self._bits = 64 if first is None else first.bits
        self._loaders: set[str] = set() if first is None else {first.loader}
        self._library = library
        self._environment = environment
        self._checked: set[Path] = set()

    def check(self, process: int, name: str) -> None:
        """Check a program that a process starts; warn about one that loads no preload library.

        Raises:
            KhepTwinError: The program loads no preload library and contains the name of a device node.
        """
        try:
            path = find_executable(str(Path(os.readlink(f"/proc/{process}/cwd"), name)))
        except (KhepTwinError, OSError):  # the process has ended, or cannot start the program
            return
        if path is None or path in self._checked:
            return
        self._checked.add(path)
        try:
            executable = check_executable(str(path))
            if executable is not None and executable.bits != self._bits:
                raise KhepTwinError(
                    f"{path}: a program of {executable.bits} bits, started by one of {self._bits} bits; "
                    "expected both for one word size"
                )
            if executable is not None and executable.loader not in self._loaders:
                check_preload(str(path), executable.loader, self._library, self._environment)
                self._loaders.add(executable.loader)
        except KhepTwinError as error:
            if self._contains_node(path):
                raise
            warnings.warn(f"{error}; it uses the devices and the clock of this computer", stacklevel=2)

    def _contains_node(self, path: Path) -> bool:
        """Return whether a file contains the name of a device node."""
        with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
            nodes = re.findall("/dev/[^:*]+", self._environment["KHEP_TWIN_PATHS"])
            return any(content.find(node.encode()) >= 0 for node in nodes)
