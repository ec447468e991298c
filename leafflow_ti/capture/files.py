"""Which files a description may name, and reading those that are text.

Only regular files are read: opening a pipe waits for ever, a device never ends. What a description names lies in its
own folder, links followed, unless its user (not the data) allows others: a folder that came from elsewhere must not
choose what else of a machine is read.
"""

from __future__ import annotations

import os
import stat
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from leafflow_ti.errors import InputError

_TIME_STEPS_NS = (10_000_000, 1_000_000_000, 2_000_000_000)
_CHECK = "check the path and its permissions"
_KINDS: tuple[tuple[Callable[[int], bool], str], ...] = (
    (stat.S_ISDIR, "a folder"),
    (stat.S_ISFIFO, "a pipe"),
    (stat.S_ISSOCK, "a socket"),
    (stat.S_ISBLK, "a device"),
    (stat.S_ISCHR, "a device"),
)


def regular(path: Path, way_out: str = _CHECK) -> os.stat_result:
    """The state of a regular file, links followed; InputError where it is missing or something else."""
    try:
        found = path.stat()
    except (OSError, ValueError) as error:
        raise unreadable(path, error, way_out) from error
    if not stat.S_ISREG(found.st_mode):
        kind = next((name for holds, name in _KINDS if holds(found.st_mode)), "something else")
        raise InputError(f"{path}: {kind}, not a file: remove it, or correct the name")
    return found


def unreadable(path: Path, error: OSError | ValueError, way_out: str = _CHECK) -> InputError:
    """What to say of a path that the system refuses; ValueError: it holds a character that no path has."""
    reason = error.strerror if isinstance(error, OSError) else str(error)
    return InputError(f"{path}: cannot be read ({reason}): {way_out}")


def read_text(path: Path, limit: int, way_out: str) -> str:
    """UTF-8 text, with or without a byte-order mark, of a regular file of at most ``limit`` bytes.

    Raises InputError, which ends in ``way_out``; UnicodeDecodeError for other bytes.
    """
    regular(path, way_out)
    try:
        with path.open("rb") as file:
            content = file.read(limit + 1)  # what was looked at before may have grown
    except OSError as error:
        raise unreadable(path, error, way_out) from error
    if len(content) > limit:
        raise InputError(f"{path}: more than {limit / 2**20:g} MiB, which is too much for this kind of file: {way_out}")
    return content.decode("utf-8-sig")


@dataclass(frozen=True, slots=True)
class FileState:
    """By what a file that was written anew is told from the one that was found."""

    size: int
    mtime_ns: int

    @classmethod
    def of(cls, found: os.stat_result) -> FileState:
        """From what the system says."""
        return cls(found.st_size, found.st_mtime_ns)

    def same(self, other: FileState) -> bool:
        """Whether this may be one state of a file: equal sizes, and times but for what a file system cuts off.

        Some keep times in steps (10 ms, 1 s, 2 s), and give the exact one until they have written it to the disk.
        """
        if self.size != other.size or self.mtime_ns == other.mtime_ns:
            return self.size == other.size
        early, late = sorted((self.mtime_ns, other.mtime_ns))
        return any(early == late - late % step for step in _TIME_STEPS_NS)


class Reach:
    """The files that a description in the folder ``root`` may name; ``outside``: also those elsewhere."""

    def __init__(self, root: Path, outside: bool = False) -> None:
        self.root, self.outside = root, outside
        self._real_root = os.path.realpath(root)
        self._folders: dict[Path, str] = {}

    def folder(self, path: Path) -> str:
        """Where a folder really is; InputError if that is outside, or links run in a circle. It need not exist."""
        if path not in self._folders:
            real = os.path.realpath(path)
            self._check(path, real)
            self._folders[path] = real
        return self._folders[path]

    def file(self, path: Path, way_out: str = _CHECK) -> os.stat_result:
        """The state of a regular file; InputError where it is missing, outside, or something else."""
        self.folder(path.parent)
        if os.path.islink(path):  # noqa: PTH114 - Path.is_symlink raises for names that are too long
            self._check(path, os.path.realpath(path))
        return regular(path, way_out)

    def _check(self, path: Path, real: str) -> None:
        if (
            not self.outside
            and real != self._real_root
            and not real.startswith(self._real_root.rstrip(os.sep) + os.sep)
        ):
            raise InputError(
                f"{path}: leads out of the folder of its capture.toml, to {real}: copy it there, or allow it with "
                "--outside (outside=True in Python)"
            )
