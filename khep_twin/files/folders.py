"""Folders that are written completely or not at all."""

import os
import shutil
from collections.abc import Generator
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path
from tempfile import mkdtemp

from khep_twin.errors import KhepTwinError
from khep_twin.files.atomic import free_name, name_taken_message, resolve
from khep_twin.process.signals import register_cleanup


@contextmanager
def atomic_folder(target: Path, force: bool) -> Generator[Path]:
    """Make a temporary folder, and rename it to `target` when it is complete; `force` replaces another one.

    Raises:
        KhepTwinError: Without `force`, `target` existed at the end; the folder has another name.
    """
    new_folders = [folder for folder in (target.parent, *target.parent.parents) if not folder.exists()]
    target.parent.mkdir(parents=True, exist_ok=True)
    # An absolute path: Minari joins relative ones twice.
    part = Path(mkdtemp(prefix=f".{target.name}.part-", dir=resolve(target.parent)))
    clear = partial(shutil.rmtree, part, ignore_errors=True)
    unregister = register_cleanup(clear)
    try:
        (part / "new").mkdir()
        yield part / "new"
        destination = target if force else free_name(target, "kept")
        if destination.exists():
            os.replace(destination, part / "old")
        os.replace(part / "new", destination)
        if destination != target:
            raise KhepTwinError(name_taken_message(target, destination))
    finally:
        clear()
        unregister()
        for folder in new_folders:
            with suppress(OSError):  # not empty if it has the target
                folder.rmdir()
