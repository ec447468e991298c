"""A results store that gets more frames: its arrays grow along t, which changes nothing but their metadata.

Readers may come at any time, and so may a kill. Maps grow first, the coordinate t last: a store has the frames that t
names, whatever its maps could hold, and one that was left between the two is mended by growing again.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from leafflow_ti.chunk_files import replace_file, write_chunk_file, writing
from leafflow_ti.errors import RunError
from leafflow_ti.results import FRAMES_PER_CHUNK, ResultStore


def extend(store: ResultStore, frames: Sequence[int]) -> ResultStore:
    """The store with these ``frames``, those that it has first; their units are still to be done.

    Raises RunError when the frames do not begin with those that it has, or it cannot be written.
    """
    frames = tuple(int(t) for t in frames)
    if frames[: len(store.frames)] != store.frames:
        raise RunError(f"{store.path}: holds frames {store.frames[0]}..{store.frames[-1]}, which are not of this run")
    if frames == store.frames:
        return store
    with writing(store.path):
        for name in (*store.names, *store.unfinished, "status"):
            _resize(store.path / name, len(frames))
        _write_frames(store, frames)
        _resize(store.path / "t", len(frames))
    return ResultStore.open(store.path)


def _resize(folder: Path, frames: int) -> None:
    """Put another length along t into the metadata of an array."""
    path = folder / "zarr.json"
    metadata = json.loads(path.read_text(encoding="utf-8"))
    if metadata["shape"][0] != frames:
        metadata["shape"][0] = frames
        replace_file(path, json.dumps(metadata, indent=2).encode(), folder)


def _write_frames(store: ResultStore, frames: Sequence[int]) -> None:
    """Chunks of the coordinate t; what they hold beyond its length is nobody's until that grows."""
    for chunk in range(len(store.frames) // FRAMES_PER_CHUNK, -(-len(frames) // FRAMES_PER_CHUNK)):
        part = frames[chunk * FRAMES_PER_CHUNK : (chunk + 1) * FRAMES_PER_CHUNK]
        values = np.zeros(FRAMES_PER_CHUNK, np.int64)  # filled up as the library does
        values[: len(part)] = part
        write_chunk_file(store.path / "t" / "c" / str(chunk), values)
