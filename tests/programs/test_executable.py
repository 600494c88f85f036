"""Programs into which no preload library can be loaded, and the folders of the library."""

import os
import shutil
import struct
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
from test_compiled_programs import machine, pytestmark, run_program

from khep_twin.errors import KhepTwinError
from khep_twin.programs import preload
from khep_twin.programs.device_server import DeviceServer
from khep_twin.programs.executable import check_executable, read_executable

__all__ = ["pytestmark"]

ARM, X86 = 40, 3
LOADER = b"/lib/loader.so\0"


def write_elf(path: Path, processor: int, *, bits: int = 32, loader: bytes = LOADER) -> Path:
    """Write the header of an executable file, and one segment that names its loader."""
    word, size = ("Q", 56) if bits == 64 else ("I", 32)
    start = 64 if bits == 64 else 52
    identity = b"\x7fELF" + bytes([bits // 32, 1, 1]) + bytes(9)
    header = struct.pack(f"<HHI{word}{word}", 2, processor, 1, 0, start)
    header += struct.pack(f"<{word}IHHHHHH", 0, 0, start, size, 1, 0, 0, 0)
    offset = start + size
    if bits == 64:
        segment = struct.pack("<IIQQQQQQ", 3, 4, offset, 0, 0, len(loader), len(loader), 1)
    else:
        segment = struct.pack("<IIIIIIII", 3, offset, 0, 0, len(loader), len(loader), 4, 1)
    path.write_bytes(identity + header + segment + loader)
    path.chmod(0o755)
    return path


def test_the_header_tells_word_size_processor_and_loader(tmp_path: Path) -> None:
    narrow = read_executable(write_elf(tmp_path / "arm", ARM))
    assert narrow == (32, ARM, 2, "/lib/loader.so")
    python = read_executable(sys.executable)
    assert python is not None
    assert python.bits == 8 * struct.calcsize("P")
    assert read_executable(tmp_path / "none") is None


@pytest.mark.parametrize("length", range(0, 99, 3))
def test_a_damaged_header_is_none_or_without_a_loader(tmp_path: Path, length: int) -> None:
    path = write_elf(tmp_path / "program", ARM)
    path.write_bytes(path.read_bytes()[:length])
    executable = read_executable(path)
    assert executable is None or executable.loader in LOADER.decode()


def test_a_program_for_the_robots_processor_is_named_and_to_be_compiled_here(tmp_path: Path) -> None:
    program = write_elf(tmp_path / "robot", ARM)
    with pytest.raises(
        KhepTwinError, match=r"robot: a program for ARM; expected one for .*compile its source"
    ):
        run_program([str(program)], machine())
    (tmp_path / "script").write_text(f"#!{program} -x\n")
    with pytest.raises(KhepTwinError, match=r"script: its interpreter .*robot: a program for ARM"):
        check_executable(str(tmp_path / "script"))


def test_scripts_in_a_circle_and_missing_files_are_left_to_the_kernel(tmp_path: Path) -> None:
    (tmp_path / "loop").write_text(f"#!{tmp_path / 'loop'}\n")
    assert check_executable(str(tmp_path / "loop")) is None
    assert check_executable(str(tmp_path / "none")) is None
    (tmp_path / "script").write_text("#!/usr/bin/none\n")
    with pytest.raises(KhepTwinError, match=r"script: its interpreter is '/usr/bin/none'"):
        check_executable(str(tmp_path / "script"))


def compile_static(folder: Path, text: str) -> Path:
    """Compile a static program that contains a text and does not end."""
    source = folder / "static.c"
    source.write_text(f'const char text[] = "{text}";\nvoid _start(void) {{ for (;;); }}\n')
    subprocess.run(["cc", "-static", "-nostdlib", "-o", folder / "static", source], check=True)
    return folder / "static"


def test_a_static_program_is_refused(programs: Path, tmp_path: Path) -> None:
    compile_static(tmp_path, "")
    with pytest.raises(KhepTwinError, match=r"static: a static program.*link it without -static"):
        run_program([str(tmp_path / "static")], machine())


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="only root can give a file away")
def test_a_setuid_program_is_refused(programs: Path, tmp_path: Path) -> None:
    program = Path(shutil.copy(programs / "drive", tmp_path / "drive"))
    os.chown(program, 12345, 12345)
    program.chmod(0o4755)
    with pytest.raises(KhepTwinError, match=r"drive: its setuid bit.*expected a copy without them"):
        run_program([str(program)], machine())


def test_a_preload_library_that_the_loader_refuses_is_one_line_before_the_start(
    programs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    compiler = tmp_path / "cc"
    compiler.write_text('#!/bin/sh\nwhile [ "$1" != -o ]; do shift; done\necho no library > "$2"\n')
    compiler.chmod(0o755)
    monkeypatch.setenv("CC", str(compiler))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    with pytest.raises(
        KhepTwinError, match=r"drive: .* does not load the preload library .*; expected a cache"
    ):
        run_program([str(programs / "drive")], machine())


def test_a_relative_cache_folder_is_one_in_the_current_folder(
    programs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    library = preload.preload_library()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", "cache")
    Path("cache/khep_twin").mkdir(parents=True)
    shutil.copy(library, "cache/khep_twin")
    shutil.copy(programs / "clocks", "clocks")
    assert run_program(["./clocks"], machine()) == 0
    assert capfd.readouterr().out.startswith("2026-01-01")


@pytest.mark.parametrize("simulated", [True, False])
def test_a_program_that_ends_without_the_preload_library_is_an_error(
    programs: Path, monkeypatch: pytest.MonkeyPatch, simulated: bool
) -> None:
    clients = property(lambda server: set[int](), lambda server, value: None)
    monkeypatch.setattr(DeviceServer, "clients", clients, raising=False)
    with pytest.raises(KhepTwinError, match=r"true: ended with code 0 and never loaded the preload library"):
        run_program(["/bin/true"], machine(), simulated=simulated)


def test_a_user_without_a_home_folder_is_asked_for_a_cache_folder(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setattr(Path, "home", refuse)
    with pytest.raises(KhepTwinError, match=r"no home folder; expected a cache folder in XDG_CACHE_HOME"):
        run_program(["/bin/true"], machine())


@pytest.mark.parametrize("command", ["{}", "env -i {}", 'python3 -c \'import os; os.execv("{}", ["x"])\''])
def test_a_child_that_loads_no_preload_library_and_names_a_device_node_ends_the_run(
    programs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, command: str
) -> None:
    monkeypatch.chdir(tmp_path)
    compile_static(tmp_path, "/dev/i2c-2")
    with pytest.raises(KhepTwinError, match=rf"{tmp_path}/static: a static program.*expected a dynamic one"):
        run_program(["sh", "-c", command.format("./static") + "; true"], machine())


def test_a_child_that_loads_no_preload_library_is_reported_once(programs: Path, tmp_path: Path) -> None:
    compile_static(tmp_path, "")
    command = f"for i in 1 2; do timeout -s KILL 0.1 {tmp_path}/static; done; exit 7"
    with pytest.warns(UserWarning, match="it uses the devices and the clock of this computer") as warnings:
        assert run_program(["sh", "-c", command], machine(), simulated=False) == 7
    assert len(warnings) == 1


def test_children_of_all_kinds_load_the_preload_library_even_without_its_variables(
    programs: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    ways = (
        "execv execve execvp execvpe execl execlp execle fexecve execveat syscall spawn spawnp system popen"
    )
    assert run_program([str(programs / "starts")], machine()) == 0
    assert capfd.readouterr().out.splitlines() == [f"{way} 2026 alone" for way in ways.split()]


def test_a_program_that_cannot_be_started_says_what_is_expected(
    programs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copy(programs / "drive", "until")
    Path("until.c").write_text("int main(void) { return 0; }\n")
    Path("text").write_text("no program\n")
    Path("text").chmod(0o755)
    for program, expected in {
        "until": r"until: cannot be started: No such file or directory; expected \./until",
        "./until.c": r"until\.c: .*denied; expected a program that may be executed: compile it, or chmod",
        str(tmp_path): "Permission denied; expected a program, not a folder",
        "./text": "Exec format error; expected a compiled program, or a script that begins with #!",
    }.items():
        with pytest.raises(KhepTwinError, match=expected):
            run_program([program], machine())


def test_options_of_the_compiler_have_no_character_of_the_shell(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sources = tmp_path / "my folder"
    shutil.copytree(preload.SOURCES / "include", sources / "include")
    monkeypatch.setattr(preload, "SOURCES", sources)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    (tmp_path / "pins.c").write_text('#include "user-gpio-drv.h"\n')
    for _ in range(2):
        flags = " ".join(preload.compiler_flags())
        subprocess.run(["sh", "-c", f"cc -c $(echo '{flags}') pins.c"], cwd=tmp_path, check=True)
    monkeypatch.setenv("XDG_CACHE_HOME", str(sources))
    with pytest.raises(KhepTwinError, match=r"my folder/include: .*expected a cache folder without one"):
        preload.compiler_flags()


def test_a_folder_for_temporary_files_is_found_if_the_usual_one_is_unusable(
    programs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    long_path = tmp_path / ("x" * 80)
    usable_path = tmp_path.parents[1]
    long_path.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(long_path))
    monkeypatch.setattr(preload, "TEMPORARY_FOLDERS", ("/none", str(usable_path)))
    monkeypatch.setattr(preload, "_MAX_FOLDER", len(str(usable_path)))
    assert run_program(["/bin/true"], machine()) == 0
    monkeypatch.setattr(preload, "TEMPORARY_FOLDERS", ("/none",))
    with pytest.raises(KhepTwinError, match=r"xxx: unusable for sockets; expected a folder in TMPDIR"):
        run_program(["/bin/true"], machine())
