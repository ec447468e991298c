"""Who may write a results store: one run alone, or the shards of one run together.

The locks are the system's: a process that is killed gives its own back, so that none is ever left behind. They lie in
the store, as empty files that stay.
"""

from __future__ import annotations

import contextlib
import re
import time
from collections.abc import Iterator
from pathlib import Path

from filelock import FileLock, Timeout

from leafflow_ti.chunk_files import writing
from leafflow_ti.errors import RunError
from leafflow_ti.events import warn

FOLDER = Path("status") / ".locks"
"""In an array's folder, where readers of Zarr do not look."""
PATIENCE_S = 5.0
"""How long a lock that others hold for a moment only is waited for."""
FORGOTTEN_S = 3600.0
"""Age of a folder without a lock that nobody will come back to: the lock is made within milliseconds."""
_SHARD = re.compile(r"shard-(\d+)-of-(\d+)\.lock")
_RUN, _ATTRIBUTES = "run.lock", "attributes.lock"


@contextlib.contextmanager
def alone(store: Path) -> Iterator[None]:
    """Nobody else writes the store while the block runs; RunError when somebody does."""
    with _held(store, _RUN) as held:
        if not held:
            raise _busy(store, "another run")
        for shard in _shards(store):
            with _held(store, shard.name) as free:
                if not free:
                    raise _busy(store, shard.stem.replace("-", " "))
        yield


@contextlib.contextmanager
def as_shard(store: Path, number: int, count: int) -> Iterator[None]:
    """Only other shards of the same ``count`` write the store while the block runs; RunError when anybody else does."""
    name = f"shard-{number}-of-{count}.lock"
    with _held(store, name) as held:
        if not held:
            raise _busy(store, f"shard {number} of {count} already")
        for other in _shards(store):
            if not other.stem.endswith(f"-of-{count}"):
                with _held(store, other.name) as free:
                    if not free:
                        raise _busy(store, other.stem.replace("-", " "))
        # Other shards hold this one just as briefly while they look.
        with _held(store, _RUN, patient=True) as free:
            if not free:
                raise _busy(store, "another run")
        yield


@contextlib.contextmanager
def changing_attributes(store: Path) -> Iterator[None]:
    """One process at a time reads the attributes and writes them again."""
    with _held(store, _ATTRIBUTES, patient=True) as held:
        if not held:
            raise _busy(store, f"for {PATIENCE_S:g} s another process")
        yield


def abandoned(store: Path) -> bool:
    """Whether a store that was being made or removed is nobody's any more: its lock is free, or was never made."""
    if not (store / FOLDER / _RUN).exists():
        with contextlib.suppress(OSError):
            return time.time() - store.stat().st_mtime > FORGOTTEN_S
        return False
    with _held(store, _RUN) as free:
        return free


@contextlib.contextmanager
def _held(store: Path, name: str, *, patient: bool = False) -> Iterator[bool]:
    """Gives whether the lock was free, or became free while this one was ``patient``; then it is held while the block
    runs."""
    folder, held = store / FOLDER, False
    lock = FileLock(folder / name, timeout=PATIENCE_S if patient else 0, poll_interval=0.02, is_singleton=False)
    try:
        with writing(store), contextlib.suppress(Timeout):
            folder.mkdir(exist_ok=True)
            lock.acquire()
            held = True
    except NotImplementedError:
        warn(f"{store}: this file system has no locks; see to it that only one run writes there at a time")
        held = True
    try:
        yield held
    finally:
        lock.release()


def _shards(store: Path) -> list[Path]:
    return sorted(path for path in (store / FOLDER).iterdir() if _SHARD.fullmatch(path.name))


def _busy(store: Path, by: str) -> RunError:
    return RunError(f"{store} is being written by {by}: wait until that has ended, or give another output")
