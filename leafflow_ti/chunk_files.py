"""Chunks of a Zarr array written as files, many side by side, each forced to the disk before it takes its name."""

from __future__ import annotations

import contextlib
import math
import os
import secrets
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numcodecs import Zstd
from numpy.typing import NDArray
from zarr.codecs import ZstdCodec

from leafflow_ti.errors import InputError, RunError

WRITERS = 16
"""Chunks that are written together: the disk forces them out at once, and while kernels run, which hold the
interpreter, each of the threads gets on a step between two of them."""
COMPRESSOR = ZstdCodec(level=0, checksum=True)
"""With checksums: a file that has changed since it was written is not read as if it had not."""


def write_chunks(
    store: Path, at: tuple[int, int], arrays: Mapping[str, zarr.Array[Any]], values: Mapping[str, NDArray[Any]]
) -> list[str]:
    """Write the chunk ``at`` (t, band) of several arrays ``[t, y, x]`` of a store, whose chunks are bands of rows.

    Returns the names of those that have a file now. Raises RunError when it is impossible.
    """
    with writing(store), ThreadPoolExecutor(WRITERS) as pool:
        have = pool.map(lambda name: _write_chunk(store, at, name, arrays[name], values[name]), values)
        return [name for name, has_file in zip(values, have, strict=True) if has_file]


def _write_chunk(store: Path, at: tuple[int, int], name: str, array: zarr.Array[Any], values: NDArray[Any]) -> bool:
    """Write one chunk file as the format prescribes, forced to the disk, without the library's own threads.

    The last band's chunk is filled up to the height of the others; one that holds nothing but the fill value has
    no file. Returns whether it has one.
    """
    if array.compressors != (COMPRESSOR,) or array.filters:
        raise RunError(f"{store}: {name} is stored in a way that this program does not write: use --overwrite")
    chunk = np.full(array.chunks[1:], array.fill_value, array.dtype)
    chunk[: len(values)] = values
    path = chunk_path(store, at, name)
    if np.array_equal(chunk, np.broadcast_to(array.fill_value, chunk.shape), equal_nan=chunk.dtype.kind == "f"):
        path.unlink(missing_ok=True)
        return False
    write_chunk_file(path, chunk)
    for folder in path.parents[1:4]:  # up to the array's: others may have made them, and not come so far
        flush(folder)
    return True


def chunk_path(store: Path, at: tuple[int, int], name: str) -> Path:
    """The file of the chunk ``at`` (t, band) of an array."""
    return store / name / "c" / str(at[0]) / str(at[1]) / "0"


def chunk_fault(store: Path, at: tuple[int, int], name: str, array: zarr.Array[Any], has_file: bool) -> str | None:
    """What is wrong with the chunk ``at`` (t, band) of an array, None where nothing is; ``has_file``: it must have."""
    try:
        packed = chunk_path(store, at, name).read_bytes()
    except FileNotFoundError:
        return "has lost its file" if has_file else None
    except OSError as error:
        return f"cannot be read ({error.strerror})"
    try:
        size = len(Zstd().decode(packed))
    except (RuntimeError, ValueError, MemoryError):
        return "cannot be decoded: its file was cut, or has changed since it was written"
    wanted = math.prod(array.chunks) * array.dtype.itemsize
    return None if size == wanted else f"holds {size} bytes instead of {wanted}"


def write_chunk_file(path: Path, chunk: NDArray[Any]) -> None:
    """Put the values of a chunk into its file; folders are made."""
    path.parent.mkdir(parents=True, exist_ok=True)
    packed = Zstd(COMPRESSOR.level, COMPRESSOR.checksum).encode(chunk.astype(chunk.dtype.newbyteorder("<"), copy=False))
    replace_file(path, packed, path.parent)


def replace_file(path: Path, content: bytes, beside: Path) -> None:
    """Give a file new contents, as a whole and for good; it is written in the folder ``beside`` first."""
    scratch = beside / f".{path.name}.{own_token()}"
    with scratch.open("wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    scratch.replace(path)
    flush(path.parent)


def remove_scratch(store: Path, at: tuple[int, int], names: Iterable[str]) -> None:
    """Remove what a killed process has left of the chunk ``at`` (t, band); nobody may be writing it."""
    for name in names:
        for left in chunk_path(store, at, name).parent.glob(".0.*"):
            left.unlink(missing_ok=True)


def make_folders(folder: Path) -> list[Path]:
    """Make a folder and its parents; returns those that have a new entry by that, which is still to be flushed."""
    missing = []
    while not folder.is_dir():
        missing.append(folder)
        folder = folder.parent
    for new in reversed(missing):
        new.mkdir(exist_ok=True)
    return [new.parent for new in missing]


def own_token() -> str:
    """Part of a file's name that no other process uses, here or on another machine."""
    return f"{os.getpid()}-{_token(os.getpid())}"


@cache
def _token(_pid: int) -> str:
    """Drawn once per process, a forked one included."""
    return secrets.token_hex(4)


@contextlib.contextmanager
def writing(store: Path) -> Iterator[None]:
    """Errors of the system become a RunError that names the store."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or str(error)
        raise RunError(f"{store}: cannot be written ({reason}): mend that, then run again with --resume") from error


UNREADABLE = (OSError, ValueError, LookupError, TypeError, AttributeError, RuntimeError, MemoryError)
"""What Zarr raises where files were cut, changed or lost."""
RESTORE = "restore it from a copy, or run again with --overwrite"
"""What helps where a store cannot even be opened."""


@contextlib.contextmanager
def reading(store: Path, way_out: str = RESTORE) -> Iterator[None]:
    """What damaged files make of the reading becomes an InputError that names the store."""
    try:
        yield
    except UNREADABLE as error:
        raise InputError(f"{store} is damaged ({error or type(error).__name__}): {way_out}") from error


def flush_tree(root: Path) -> None:
    """Force a folder to the disk with all that is in it."""
    for folder, _, files in os.walk(root, topdown=False):
        for name in files:
            flush(Path(folder) / name)
        flush(Path(folder))


def flush(path: Path) -> None:
    """Force a file, or the entries of a folder, to the disk."""
    if path.is_dir() and os.name == "nt":  # Windows opens no folders and needs no such step
        return
    handle = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
