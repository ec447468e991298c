"""Results stores take their name when they are whole, and lose it when another one is: never is half of one there."""

from __future__ import annotations

import contextlib
import glob
import re
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path

from leafflow_ti.chunk_files import flush, flush_tree, own_token
from leafflow_ti.locks import abandoned, alone

_NEW = ".new."
"""Begins the name of a folder in which arrays are made."""
_OLD = ".old"
"""Ends the name of a store that is being replaced."""


def put_in_place(scratch: Path, path: Path, overwrite: bool) -> bool:
    """Give a new store its name, with ``overwrite`` in place of the one that has it; whether that was possible.

    Raises RunError where that one is being written, OSError where files cannot be renamed.
    """
    if not (overwrite and path.exists()):
        try:
            scratch.rename(path)
        except OSError:
            if path.exists():  # somebody else's has appeared meanwhile
                return False
            raise
        flush_names(path)
        return True
    old = path.with_name(f"{scratch.name}{_OLD}")
    with alone(path):
        path.rename(old)
        scratch.rename(path)
    flush_names(path)
    shutil.rmtree(old, ignore_errors=True)  # what is left of it goes when the store is opened or made again
    return True


def flush_names(path: Path) -> None:
    """Force the names of a store and of its folder to the disk, where a process that was killed may have given them."""
    for folder in path.absolute().parents[:2]:
        with contextlib.suppress(PermissionError):  # a folder that others own, and that cannot be opened
            flush(folder)


def remove_abandoned(path: Path) -> None:
    """Remove what processes that were killed while they made or replaced a store have left beside it."""
    for left in path.parent.glob(f".{glob.escape(path.name)}.*-*"):
        ours = re.fullmatch(rf"\.\d+-[0-9a-f]{{8}}({re.escape(_OLD)})?", left.name.removeprefix(f".{path.name}"))
        if ours and abandoned(left):
            shutil.rmtree(left, ignore_errors=True)


@contextlib.contextmanager
def whole_arrays(store: Path, names: Sequence[str]) -> Iterator[Path]:
    """Gives a folder, out of readers' sight, in which to make arrays of a store; they take their names at the end, in
    place of those that have them. Nobody else may be doing so."""
    hidden = store / "status"
    for left in hidden.glob(f"{_NEW}*"):
        shutil.rmtree(left)
    scratch = hidden / f"{_NEW}{own_token()}"
    try:
        yield scratch
        flush_tree(scratch)
        replaced = scratch / "replaced"
        replaced.mkdir()
        for name in names:
            if (store / name).exists():
                (store / name).rename(replaced / name)
            (scratch / name).rename(store / name)
        flush(store)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
