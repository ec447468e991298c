"""Files that may change, shrink or vanish while they are read: what is read belongs to one state of the file.

Nothing is memory-mapped: touching a map of a file that was cut short ends the process without a word.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np
import numpy.typing as npt

from leafflow_ti.capture.files import FileState, regular, unreadable
from leafflow_ti.errors import InputError

_LONGEST = 200
"""Characters of another library's text in a line of ours."""
BLOCK = 2**20
"""Bytes read in one go where windows are narrower than the image: whole rows, of which pieces are kept."""
_SKIPPED = 2**16
"""Bytes between the pieces of two rows from which on each piece is read by itself."""


@dataclass(frozen=True, slots=True)
class StoredFile:
    """A regular file as it was when it was looked at; a key for what was learnt from it."""

    path: Path
    state: FileState

    @property
    def size(self) -> int:
        """Bytes."""
        return self.state.size

    @contextmanager
    def open(self, buffering: int = -1) -> Iterator[OpenFile]:
        """The file, open; raises InputError if it cannot be, or is not as it was, before or after it was read."""
        try:
            handle = self.path.open("rb", buffering)
        except OSError as error:
            raise unreadable(self.path, error) from error
        with handle:
            opened = OpenFile(self, handle)
            opened.check_unchanged()
            try:
                yield opened
            finally:
                opened.check_unchanged()

    def read_all(self) -> bytes:
        """All bytes; raises InputError like ``open``."""
        with self.open(buffering=0) as file:
            return file.read(0, self.size)


class OpenFile:
    """An open file whose reads give all bytes asked for or raise InputError."""

    def __init__(self, stored: StoredFile, handle: IO[bytes]) -> None:
        self._stored = stored
        self.handle = handle

    def check_unchanged(self) -> None:
        """Raise InputError if size or time are no longer those of the state that was looked at."""
        found = FileState.of(os.fstat(self.handle.fileno()))
        if not self._stored.state.same(found):
            raise InputError(
                f"{self._stored.path}: changed while it was read (from {self._stored.size} to {found.size} bytes): "
                "wait until it is written, then run again"
            )

    def read(self, offset: int, count: int) -> bytes:
        """``count`` bytes from ``offset``."""
        if offset + count > self._stored.size:
            raise self._short(offset + count)
        data = b""
        with self._reading():
            self.handle.seek(offset)
            while len(data) < count:
                more = self.handle.read(count - len(data))
                if not more:
                    raise self._short(offset + count)
                data = data + more if data else more
        return data

    def read_rows(self, offset: int, pitch: int, rows: int, first: int, last: int) -> npt.NDArray[np.uint8]:
        """Bytes ``first`` to ``last`` of each of ``rows`` rows of ``pitch`` bytes, ``[rows, last - first]``."""
        part = np.empty((rows, last - first), np.uint8)
        with self._reading():
            if last - first == pitch:
                self._fill(part.reshape(-1).data, offset)
            elif pitch - (last - first) > _SKIPPED:
                for row in range(rows):
                    self._fill(part[row].data, offset + row * pitch + first)
            else:
                step = max(1, BLOCK // pitch)
                block = np.empty((min(step, rows), pitch), np.uint8)
                for row in range(0, rows, step):
                    whole = block[: rows - row]
                    self._fill(whole.reshape(-1).data, offset + row * pitch)
                    part[row : row + step] = whole[:, first:last]
        return part

    def _fill(self, view: memoryview, offset: int) -> None:
        end = offset + view.nbytes
        self.handle.seek(offset)
        while view.nbytes:
            count = self.handle.readinto(view)  # type: ignore[attr-defined]
            if not count:
                raise self._short(end)
            view = view[count:]

    @contextmanager
    def _reading(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise unreadable(self._stored.path, error) from error

    def _short(self, end: int) -> InputError:
        path, size = self._stored.path, self._stored.size
        return InputError(f"{path}: data end at byte {end}, the file at {size}: truncated, copy or write it again")


def look_at(path: Path) -> StoredFile:
    """A regular file as it is now; raises InputError if there is none."""
    return StoredFile(path, FileState.of(regular(path)))


def one_line(error: BaseException) -> str:
    """Text of an error without line breaks, or its kind if it has none that can be read (decoders may give memory that
    is no longer theirs)."""
    text = " ".join(str(error).split())
    if not text or not text.isprintable():
        return type(error).__name__
    return text if len(text) <= _LONGEST else text[:_LONGEST] + "..."
