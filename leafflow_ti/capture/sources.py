"""Where the grey values of a capture are: in files, or in an array."""

from __future__ import annotations

import hashlib
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from leafflow_ti.capture.cache import ImageCache
from leafflow_ti.capture.capture import Capture
from leafflow_ti.capture.channels import Array, Channel
from leafflow_ti.capture.images import checksum, read_window
from leafflow_ti.capture.layout import Layout
from leafflow_ti.errors import InputError


@dataclass(frozen=True, eq=False)
class FileCapture(Capture):
    """A capture on disk; decoded images are cached where the format allows no windows."""

    layout: Layout = field(repr=False)
    channel: Channel
    _cache: ImageCache = field(repr=False)

    def _window(self, t: int, sy: int, sx: int, y0: int, y1: int, x0: int, x1: int) -> Array:
        path, page = self.layout.paths[self.layout.file[t, sy, sx]], int(self.layout.page[t, sy, sx])
        if self.layout.info.windowed:
            return self._checked(path, read_window(path, page, self.channel, y0, y1, x0, x1))
        return self._cache.get((path, page), lambda: self._decode(path, page))[y0:y1, x0:x1]

    @property
    def cacheable_bytes(self) -> int:
        """See ``Capture``; a mixture of colours is kept as float."""
        if self.layout.info.windowed:
            return 0
        itemsize = self.dtype.itemsize if self.layout.info.colour == "gray" else max(4, self.dtype.itemsize)
        return math.prod(self.shape) * itemsize

    def keep_decoded(self, n_bytes: int) -> None:
        """See ``Capture``."""
        self._cache.set_limit(n_bytes)

    def image_name(self, t: int, sy: int, sx: int) -> str:
        """The file, and the page where it holds several."""
        path, page = self.layout.paths[self.layout.file[t, sy, sx]], int(self.layout.page[t, sy, sx])
        return f"{path}, page {page}" if page else str(path)

    def _decode(self, path: Path, page: int) -> Array:
        image = self._checked(path, read_window(path, page, self.channel, 0, self.height, 0, self.width))
        return np.ascontiguousarray(image)

    def _checked(self, path: Path, values: Array) -> Array:
        """A stated bit depth must hold: a wrong one would give wrong error bars without a word."""
        if self.bits < 8 * self.dtype.itemsize and self.dtype.kind in "ui" and values.max() > 2**self.bits - 1:
            raise InputError(f"{path}: grey value {values.max():g} does not fit bit_depth = {self.bits}: correct it")
        return values

    def fingerprint(self, contents: bool = True) -> dict[str, Any]:
        """Number of files, sha256 over their names (relative to the description) and sizes, and sha256 of the bytes
        of the first and the last file: the same for a copy elsewhere, cheap for any length of sequence."""
        assert self.path is not None
        root = self.path.parent
        listing = hashlib.sha256()
        for path in self.layout.paths:
            name = path.relative_to(root) if path.is_relative_to(root) else path
            listing.update(f"{name.as_posix()}\0{path.stat().st_size}\n".encode())
        ends = {"first_file_sha256": self.layout.paths[0], "last_file_sha256": self.layout.paths[-1]}
        calibrations = dict.fromkeys(lens.calibration.path for row in self.lenses or () for lens in row)
        return {
            **({"calibration_sha256": [checksum(path) for path in calibrations]} if calibrations else {}),
            "files": len(self.layout.paths),
            "names_and_sizes_sha256": listing.hexdigest(),
            **({name: checksum(path) for name, path in ends.items()} if contents else {}),
            **self._measured(),
        }


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
