"""Chunks of a Zarr array written as files, many side by side, each forced to the disk before it takes its name."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from numcodecs import Zstd
from numpy.typing import NDArray
from zarr.codecs import ZstdCodec

from leafflow_ti.errors import RunError

WRITERS = 16
"""Chunks that are written together: the disk forces them out at once, and while kernels run, which hold the
interpreter, each of the threads gets on a step between two of them."""
COMPRESSOR = ZstdCodec(level=0, checksum=False)


def write_chunks(
    store: Path, at: tuple[int, int], arrays: Mapping[str, zarr.Array[Any]], values: Mapping[str, NDArray[Any]]
) -> None:
    """Write the chunk ``at`` (t, band) of several arrays ``[t, y, x]`` of a store, whose chunks are bands of rows.

    Raises RunError when that is impossible.
    """
    with writing(store), ThreadPoolExecutor(WRITERS) as pool:
        for _ in pool.map(lambda name: _write_chunk(store, at, name, arrays[name], values[name]), values):
            pass


def _write_chunk(store: Path, at: tuple[int, int], name: str, array: zarr.Array[Any], values: NDArray[Any]) -> None:
    """Write one chunk file as the format prescribes, forced to the disk, without the library's own threads.

    The last band's chunk is filled up to the height of the others; one that holds nothing but the fill value has
    no file.
    """
    if array.compressors != (COMPRESSOR,) or array.filters:
        raise RunError(f"{store}: {name} is stored in a way that this program does not write: use --overwrite")
    chunk = np.full(array.chunks[1:], array.fill_value, array.dtype)
    chunk[: len(values)] = values
    folder = store / name / "c" / str(at[0]) / str(at[1])
    if np.array_equal(chunk, np.broadcast_to(array.fill_value, chunk.shape), equal_nan=chunk.dtype.kind == "f"):
        (folder / "0").unlink(missing_ok=True)
        return
    folder.mkdir(parents=True, exist_ok=True)
    scratch = folder / ".0"
    with scratch.open("wb") as file:
        file.write(Zstd(level=COMPRESSOR.level).encode(chunk.astype(chunk.dtype.newbyteorder("<"), copy=False)))
        file.flush()
        os.fsync(file.fileno())
    scratch.replace(folder / "0")


@contextlib.contextmanager
def writing(store: Path) -> Iterator[None]:
    """Errors of the system become a RunError that names the store."""
    try:
        yield
    except OSError as error:
        reason = error.strerror or str(error)
        raise RunError(f"{store}: cannot be written ({reason}): mend that, then run again with --resume") from error


def flush(path: Path) -> None:
    """Force a file, or the entries of a folder, to the disk."""
    if path.is_dir() and os.name == "nt":  # Windows opens no folders and needs no such step
        return
    handle = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
