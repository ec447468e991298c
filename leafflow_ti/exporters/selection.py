"""What is exported: some frames and some maps of a results store, read one frame at a time."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.errors import InputError, RunError, UsageError
from leafflow_ti.field import Field
from leafflow_ti.results import ResultStore

_GEOMETRY = ("depth", "slope_x", "slope_y")


@dataclass(frozen=True)
class Selection:
    """``indices``: positions along t of the frames; ``names``: maps, without the status; ``status``: with it."""

    store: ResultStore
    indices: tuple[int, ...]
    names: tuple[str, ...]
    status: bool

    @classmethod
    def of(cls, store: ResultStore, frames: str | None = None, maps: Sequence[str] | None = None) -> Selection:
        """Frames ``A:B`` (indices of the store's frames, B excluded) and maps by name or pattern, such as ``depth*``.

        Raises UsageError for a range that is none, InputError for frames and maps that the store does not have,
        RunError for a store that is not finished.
        """
        missing = store.n_units - len(store.done())
        if missing:
            raise RunError(
                f"{store.path}: {missing} of {store.n_units} units are not done: finish it with run --resume"
            )
        known = (*store.names, "status")
        wanted = set(known if maps is None else _matching(store, known, maps))
        names = tuple(name for name in store.names if name in wanted)
        return cls(store, _indices(store, frames), names, "status" in wanted)

    @property
    def frames(self) -> tuple[int, ...]:
        """Indices of the frames in the capture."""
        return tuple(self.store.frames[i] for i in self.indices)

    @property
    def times_s(self) -> NDArray[np.float64] | None:
        """Time of each frame [s], None when unknown."""
        times = self.store.times_s
        return None if times is None else times[list(self.indices)]

    @property
    def all_names(self) -> tuple[str, ...]:
        """The maps, and the status where it was chosen."""
        return (*self.names, *(["status"] if self.status else []))

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of every map."""
        return (self.store.y.size, self.store.x.size)

    @property
    def pitch(self) -> tuple[float, float]:
        """Pixels of the image between neighbouring rows, and columns, of the maps."""
        y, x = (float(a[1] - a[0]) if a.size > 1 else 1.0 for a in (self.store.y, self.store.x))
        return y, x

    def values(self, name: str, index: int) -> NDArray[Any]:
        """One map, or ``"status"``, of the frame at ``index`` along t."""
        return self.store.read(name, index)

    def fields(self, surface: bool = False) -> Iterator[Field]:
        """The chosen maps and the status of one frame after the other; ``surface``: with those of its shape."""
        names = [n for n in self.store.names if n in self.names or (surface and n in _GEOMETRY)]
        attrs = self.store.attrs
        for index in self.indices:
            maps = {name: self.values(name, index) for name in names}
            status = self.values("status", index)
            yield Field(maps, status, self.store.y, self.store.x, self.store.frames[index], attrs)


def _matching(store: ResultStore, known: Sequence[str], patterns: Sequence[str]) -> list[str]:
    found = []
    for pattern in patterns:
        names = [name for name in known if fnmatchcase(name, pattern)]
        if not names:
            raise InputError(f"{store.path}: has no map {pattern!r}; it has: {', '.join(known)}")
        found += names
    return found


def _indices(store: ResultStore, frames: str | None) -> tuple[int, ...]:
    if frames is None:
        return tuple(range(len(store.frames)))
    first, colon, last = frames.partition(":")
    try:
        start, stop = int(first or store.frames[0]), int(last or store.frames[-1] + 1)
    except ValueError:
        colon = ""
    if not colon:
        raise UsageError(f"frames {frames!r}: give A:B, the indices of the first frame and of that after the last one")
    found = tuple(i for i, frame in enumerate(store.frames) if start <= frame < stop)
    if not found:
        raise InputError(f"{store.path}: holds the frames {store.frames[0]}..{store.frames[-1]}, none in {frames}")
    return found
