"""Python processes forked from one that has imported the commands: a start takes 20 ms, not a second.

`Forked` is `subprocess.Popen` for `[sys.executable, "-m" | "-c" | FILE, …]`. Such a process differs from one
that is executed in what Python reads once at its start (`PYTHONPATH`, `PYTHONHASHSEED`, …), in the name that
the system shows, and in the time that it takes to begin: tests of these execute theirs.
"""

import atexit
import ctypes
import fcntl
import gc
import importlib
import json
import os
import runpy
import signal
import socket
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

PRELOADED = (
    "khep_twin.board.gripper_body",
    "khep_twin.cli.app",
    "khep_twin.cli.serve",
    "khep_twin.host",
    "khep_twin.host.khepera",
    "khep_twin.lab.experiment.experiment",
    "khep_twin.lab.experiment.series_run",
    "khep_twin.log.recorder",
    "khep_twin.ports.link",
    "khep_twin.ports.network",
    "khep_twin.ports.pty",
    "khep_twin.ports.relay",
    "khep_twin.ports.serve",
    "khep_twin.ports.twin",
    "khep_twin.robots.khepera.robot",
    "khep_twin.ros.fleet",
    "khep_twin.ros.twin_robots",
    "khep_twin.cli.exec",
    "khep_twin.vision.k213_body",
    "serial.rfc2217",
)
_SUBREAPER = 36  # PR_SET_CHILD_SUBREAPER of prctl(2): who inherits a process whose parent has ended
_ABOVE = 200
"""First descriptor that a new process uses for those which it is to give their numbers."""

_PARENT_ENVIRONMENT = dict(os.environ)
_lock = threading.Lock()
_control: socket.socket | None = None


def _connection() -> socket.socket:
    """Return the connection to the process that forks, begun by the first who needs it."""
    global _control
    if _control is None:
        _control, other = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with other:
            nowhere, number = subprocess.DEVNULL, other.fileno()
            command = [sys.executable, __file__, str(number)]
            server = subprocess.Popen(
                command, stdin=nowhere, stdout=nowhere, pass_fds=[number], env=_PARENT_ENVIRONMENT
            )
        atexit.register(_end, _control, server)
    return _control


def _end(control: socket.socket, server: "subprocess.Popen[bytes]") -> None:
    control.close()
    server.wait()


class _Forked(subprocess.Popen[Any]):
    """A process that is forked, not executed."""

    def _execute_child(  # what `Popen` calls between making its pipes and reading them
        self, args: Any, executable: Any, preexec_fn: Any, close_fds: Any, pass_fds: Any, cwd: Any, env: Any,
        startupinfo: Any, creationflags: Any, shell: Any, p2cread: int, p2cwrite: int, c2pread: int,
        c2pwrite: int, errread: int, errwrite: int, *settings: Any,
    ) -> None:  # fmt: skip
        words = [str(word) for word in args]
        assert words[0] == sys.executable, words
        passed_descriptors = {0: p2cread, 1: c2pwrite, 2: errwrite} | {
            descriptor: descriptor for descriptor in pass_fds
        }
        request = {
            "words": words[1:],
            "folder": str(cwd or Path.cwd()),
            "environment": {**os.environ} if env is None else {**env},
            "descriptors": [*passed_descriptors],
            "session": bool(settings[5]),
        }
        sources = [number if source == -1 else source for number, source in passed_descriptors.items()]
        with _lock:
            control, prctl = _connection(), ctypes.CDLL(None).prctl
            prctl(_SUBREAPER, 1, 0, 0, 0)
            try:
                socket.send_fds(control, [json.dumps(request).encode()], sources)
                self.pid = int(control.recv(100))
            finally:
                prctl(_SUBREAPER, 0, 0, 0, 0)
        self._child_created = True
        self._close_pipe_fds(p2cread, p2cwrite, c2pread, c2pwrite, errread, errwrite)  # type: ignore[attr-defined]


Forked = _Forked if sys.platform == "linux" else subprocess.Popen[Any]


def run_python(words: list[object], **settings: Any) -> "subprocess.CompletedProcess[str]":
    """Run a program to its end, as `subprocess.run(words, text=True)` does."""
    standard_input = settings.pop("input", None)
    timeout = settings.pop("timeout", None)
    ways = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE} | settings
    with Forked(words, **{"text": True, **ways}) as process:
        try:
            out, errors = process.communicate(standard_input, timeout)
        except BaseException:
            process.kill()
            raise
    return subprocess.CompletedProcess(words, process.returncode, out, errors)


def _serve(control: socket.socket) -> None:
    """Fork a process for each request, until nobody can ask any more; return in the new ones alone."""
    while True:
        data, descriptors, _, _ = socket.recv_fds(control, 1 << 20, 100)
        if not data:
            os._exit(0)
        reader, writer = os.pipe()
        parent = os.fork()
        if parent == 0:
            signal.signal(signal.SIGINT, signal.default_int_handler)  # before anyone knows the new one
            if child := os.fork():
                os.write(writer, str(child).encode())
                os._exit(0)
            for descriptor in (control.detach(), reader, writer):
                os.close(descriptor)
            _become(json.loads(data), descriptors)
            return
        os.waitpid(parent, 0)  # now the new one is a child of who has asked
        control.send(os.read(reader, 100))
        for descriptor in (*descriptors, reader, writer):
            os.close(descriptor)


def _become(request: dict[str, Any], descriptors: list[int]) -> None:
    """Take on the descriptors, folder, environment and arguments of a request, and run its program."""
    moved = [fcntl.fcntl(descriptor, fcntl.F_DUPFD_CLOEXEC, _ABOVE) for descriptor in descriptors]
    for own_descriptor in descriptors:
        os.close(own_descriptor)
    for source, number in zip(moved, request["descriptors"], strict=True):
        os.dup2(source, number)
        os.close(source)
    if request["session"]:
        os.setsid()
    os.chdir(request["folder"])
    os.environ.clear()
    os.environ.update(request["environment"])
    sys.stdin = sys.__stdin__ = open(0, closefd=False)
    sys.stdout = sys.__stdout__ = open(1, "w", closefd=False)
    sys.stderr = sys.__stderr__ = open(2, "w", 1, errors="backslashreplace", closefd=False)
    kind, *rest = request["words"]
    sys.path[0] = "" if kind in ("-m", "-c") else str(Path(kind).resolve().parent)
    if kind == "-m":
        sys.argv = rest
        runpy.run_module(rest[0], run_name="__main__", alter_sys=True)
    elif kind == "-c":
        sys.argv = ["-c", *rest[1:]]
        main = type(sys)("__main__")
        sys.modules["__main__"] = main
        exec(compile(rest[0], "<string>", "exec"), main.__dict__)
    else:
        sys.argv = [kind, *rest]
        runpy.run_path(kind, run_name="__main__")


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    for _name in PRELOADED:
        importlib.import_module(_name)
    gc.collect()
    gc.freeze()
    _serve(socket.socket(fileno=int(sys.argv[1])))
