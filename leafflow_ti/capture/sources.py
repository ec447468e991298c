"""Where the grey values of a capture are: in files, or in an array."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from leafflow_ti.capture.cache import ImageCache
from leafflow_ti.capture.capture import Capture
from leafflow_ti.capture.changes import pack, parts
from leafflow_ti.capture.channels import Array, Channel
from leafflow_ti.capture.files import FileState, regular, unreadable
from leafflow_ti.capture.images import checksum, read_window
from leafflow_ti.capture.layout import Layout
from leafflow_ti.capture.stored import BLOCK
from leafflow_ti.errors import InputError

MIXING_BYTES = 28
"""Of a pixel while its colours are mixed to grey, in double precision."""


@dataclass(frozen=True, eq=False)
class FileCapture(Capture):
    """A capture on disk; decoded images are cached where the format allows no windows."""

    layout: Layout = field(repr=False)
    channel: Channel
    _cache: ImageCache = field(repr=False)

    def _window(self, t: int, sy: int, sx: int, y0: int, y1: int, x0: int, x1: int) -> Array:
        index, page = int(self.layout.file[t, sy, sx]), int(self.layout.page[t, sy, sx])
        if self.layout.info.windowed:
            return self._stored(index, page, y0, y1, x0, x1)
        return self._cache.get((index, page), lambda: self._decode(index, page))[y0:y1, x0:x1]

    def stored_rows(self, t: int, sy: int, sx: int, y0: int, y1: int) -> Array:
        """See ``Capture``; nothing is kept."""
        index, page = int(self.layout.file[t, sy, sx]), int(self.layout.page[t, sy, sx])
        return self._stored(index, page, y0, y1, 0, self.width)

    @property
    def reads_windows(self) -> bool:
        """See ``Capture``."""
        return self.layout.info.windowed

    @property
    def cacheable_bytes(self) -> int:
        """See ``Capture``; a mixture of colours is kept as float."""
        if self.layout.info.windowed:
            return 0
        itemsize = self.dtype.itemsize if self.layout.info.colour == "gray" else max(4, self.dtype.itemsize)
        return math.prod(self.shape) * itemsize

    def _decoding_bytes(self, rows: int, cols: int) -> int:
        """See ``Capture``: samples as stored, with those beside them, as they are chosen, their mixture."""
        info = self.layout.info
        pixels = rows * cols if info.windowed else 2 * self.height * self.width
        sample = info.samples * self.dtype.itemsize
        mixture = 0 if info.colour == "gray" else MIXING_BYTES
        stored = max(pixels * sample, min(BLOCK, rows * self.width * sample))
        return pixels * (sample + mixture) + stored

    def keep_decoded(self, n_bytes: int) -> None:
        """See ``Capture``."""
        self._cache.set_limit(n_bytes)

    def image_name(self, t: int, sy: int, sx: int) -> str:
        """The file, and the page where it holds several."""
        path, page = self.layout.paths[self.layout.file[t, sy, sx]], int(self.layout.page[t, sy, sx])
        return f"{path}, page {page}" if page else str(path)

    def _decode(self, index: int, page: int) -> Array:
        return np.ascontiguousarray(self._stored(index, page, 0, self.height, 0, self.width))

    def _stored(self, index: int, page: int, y0: int, y1: int, x0: int, x1: int) -> Array:
        """Window of a page of one file, which must be what it was when the capture was opened: another would be
        measured together with the old ones, or torn between two of its states."""
        path = self.layout.paths[index]
        try:
            values = self._checked(path, read_window(path, page, self.channel, y0, y1, x0, x1))
        except InputError:
            self._check_unchanged(index)  # then this is why
            raise
        self._check_unchanged(index)
        return values

    def _check_unchanged(self, index: int) -> None:
        path, before = self.layout.paths[index], self.layout.states[index]
        now = FileState.of(regular(path))
        if not now.same(before):
            what = f"{before.size} bytes, now {now.size}" if now.size != before.size else "written anew"
            raise InputError(
                f"{path}: changed while the capture was in use ({what}): open it again when nothing writes "
                "to its images"
            )

    def _checked(self, path: Path, values: Array) -> Array:
        """A stated bit depth must hold: a wrong one would give wrong error bars without a word."""
        if self.bits < 8 * self.dtype.itemsize and self.dtype.kind in "ui" and values.max() > 2**self.bits - 1:
            raise InputError(f"{path}: grey value {values.max():g} does not fit bit_depth = {self.bits}: correct it")
        return values

    def _files(self) -> Iterator[tuple[str, FileState]]:
        """Names, relative to the description where they can be, and states."""
        assert self.path is not None
        root = self.path.parent
        for path, state in zip(self.layout.paths, self.layout.states, strict=True):
            name = path.relative_to(root) if path.is_relative_to(root) else path
            yield name.as_posix(), state

    def frames_of(self, name: str) -> set[int]:
        """Frames of which a file, named as in the listing, holds images; none for a file that is not of the capture."""
        at = [index for index, (known, _) in enumerate(self._files()) if known == name]
        return set(np.nonzero(np.isin(self.layout.file, at).any(axis=(1, 2)))[0].tolist())

    @property
    def listing(self) -> str:
        """Names, sizes and times of the files when the capture was opened, for ``changes``."""
        return pack(self._files())

    def fingerprint(self, contents: bool = True) -> dict[str, Any]:
        """Number of files, sha256 over their names (relative to the description) and sizes, and sha256 of the bytes of
        ``changes.parts``: the same for a copy elsewhere, cheap for any length of sequence."""
        names = hashlib.sha256()
        for name, state in self._files():
            names.update(f"{name}\0{state.size}\n".encode("utf-8", "surrogateescape"))
        calibrations = dict.fromkeys(lens.calibration.path for row in self.lenses or () for lens in row)
        return {
            **({"calibration_sha256": [checksum(path) for path in calibrations]} if calibrations else {}),
            "files": len(self.layout.paths),
            "names_and_sizes_sha256": names.hexdigest(),
            **({"contents_sha256": self._contents()} if contents else {}),
            **self._measured(),
        }

    def _contents(self) -> str:
        digest = hashlib.sha256()
        files = zip(self.layout.paths, (state.size for state in self.layout.states), strict=True)
        for path, offset, count in parts(files):
            try:
                with path.open("rb") as file:
                    file.seek(offset)
                    digest.update(file.read(count))
            except OSError as error:
                raise unreadable(path, error) from error
        return digest.hexdigest()


@dataclass(frozen=True, eq=False)
class ArrayCapture(Capture):
    """A capture in memory."""

    images: Array = field(repr=False)  # [t, sy, sx, y, x]

    def _window(self, t: int, sy: int, sx: int, y0: int, y1: int, x0: int, x1: int) -> Array:
        window: Array = self.images[t, sy, sx, y0:y1, x0:x1]
        return window

    def fingerprint(self, contents: bool = True) -> dict[str, Any]:
        """Shape, type, and sha256 of the values in C order."""
        found: dict[str, Any] = {"shape": list(self.images.shape), "dtype": str(self.dtype)}
        if contents:
            found["sha256"] = hashlib.sha256(np.ascontiguousarray(self.images).data).hexdigest()
        return found | self._measured()
