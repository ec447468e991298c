"""The folder of compiled kernels: where it is, that nobody else writes there, and that its files are as they were
written.

The engine notices files that are cut off, but compiles them again and again, and it believes all others: changed bytes
end the process, or worse, are executed. So checksums are kept beside the files; where they differ, all are removed.
"""

from __future__ import annotations

import contextlib
import json
import os
import stat
import tempfile
import time
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path

import platformdirs
from filelock import FileLock, Timeout

from leafflow_ti.events import warn

INDEX = "ticache.tcb"
FILES = ("*.tic", INDEX, "kernel_compilation_manager/*.qdc", "kernel_compilation_manager/qdcache.qdb")
"""Files of the engines, Taichi's and those of Quadrants: one per kernel, and one with what is known of them."""
LOCKS = ("ticache.lock", "kernel_compilation_manager/qdcache.lock")
"""What the engines lock their files by."""
SUMS = "checksums.json"
LOCK = "checksums.lock"
STALE_LOCK_S = 60.0
PATIENCE_S = 10.0
"""How long other processes may take to write what they have compiled."""


def cache_folder() -> Path | None:
    """The folder for compiled kernels, that of the user or ``LEAFFLOW_TI_CACHE``; None, with a warning, where nothing
    can be kept, or where others could put code that this process would execute."""
    wanted = os.environ.get("LEAFFLOW_TI_CACHE")
    folder = Path(wanted) if wanted else Path(platformdirs.user_cache_dir("leafflow-ti", False)) / "kernels"
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
        if os.name == "posix" and folder.stat().st_mode & stat.S_IWOTH:
            reason = "everybody may write there, and what lies there is executed: chmod o-w"
        else:
            return folder
    except OSError as error:
        reason = error.strerror or type(error).__name__
    warn(f"compiled kernels are not kept in {folder} ({reason}), so that every process compiles them anew, for half a "
         "minute: set LEAFFLOW_TI_CACHE to a folder of yours", folder=str(folder))  # fmt: skip
    return None


def remove_stale_lock(folder: Path) -> None:
    """The engine locks its cache by a file for milliseconds; one that was killed then leaves it, and no process after
    it would use the cache again."""
    for lock in (folder / name for name in LOCKS):
        with contextlib.suppress(OSError):
            if time.time() - lock.stat().st_mtime > STALE_LOCK_S:
                lock.unlink()


def remove_damaged(folder: Path) -> None:
    """Before the engine reads a folder: if any file is not as ``write`` left it, all are removed, with a warning."""
    with _locked(folder):
        expected = _read_sums(folder)
        damaged = [name for name, found in _sums(folder).items() if expected.get(name, found) != found]
        if damaged:
            warn(f"{len(damaged)} compiled kernels in {folder} are damaged ({damaged[0]}): all are compiled anew",
                 folder=str(folder))  # fmt: skip
            for file in _files(folder):
                file.unlink(missing_ok=True)


def write(folder: Path, flush: Callable[[], None]) -> None:
    """Let the engine write what it has compiled (``flush``), and keep the checksums of all files."""
    with _locked(folder):
        flush()
        with contextlib.suppress(OSError):  # removed, or full: then they are compiled again
            scratch = folder / f"{SUMS}.{os.getpid()}"
            scratch.write_text(json.dumps(_sums(folder)), encoding="ascii")
            scratch.replace(folder / SUMS)


@contextlib.contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """One process at a time, as far as the file system has locks."""
    with contextlib.ExitStack() as held:
        with contextlib.suppress(Timeout, OSError, NotImplementedError):
            held.enter_context(FileLock(folder / LOCK, timeout=PATIENCE_S))
        yield


def _files(folder: Path) -> list[Path]:
    return sorted(file for pattern in FILES for file in folder.glob(pattern))


def _sums(folder: Path) -> dict[str, int]:
    found = {}
    for file in _files(folder):
        with contextlib.suppress(OSError):  # the engine removes what was not used for long
            found[file.relative_to(folder).as_posix()] = zlib.crc32(file.read_bytes())
    return found


def _read_sums(folder: Path) -> dict[str, int]:
    """Name -> checksum; nothing where none were kept."""
    with contextlib.suppress(OSError, ValueError):
        found = json.loads((folder / SUMS).read_text(encoding="ascii"))
        if isinstance(found, dict):
            return found
    return {}
