"""Range maps that are given: the ``depth`` of a results store, a stack, or a file per frame [mm]; NaN: no value.

White noise of the range (see ``range_flow``): of a results store from its standard errors and the window that it was
smoothed over, else estimated from the maps themselves.
"""

from __future__ import annotations

import hashlib
import tomllib
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.capture import Capture
from leafflow_ti.capture.files import Reach
from leafflow_ti.capture.images import probe, read_gray
from leafflow_ti.capture.pattern import Pattern
from leafflow_ti.config_sections import WindowSection
from leafflow_ti.errors import ConfigError, InputError
from leafflow_ti.filters import gaussian_weights
from leafflow_ti.noise import white_noise
from leafflow_ti.range_flow import FINEST_RANGE
from leafflow_ti.results import ResultStore

Array = NDArray[Any]


class GivenRange(ABC):
    """Range maps of the reference camera, in its pixels."""

    path: str

    @abstractmethod
    def frame(self, t: int) -> tuple[Array, Array]:
        """Depth and the standard error that it is shown with [mm], [height, width]; NaN where there is none."""

    @property
    @abstractmethod
    def middle(self) -> int:
        """The frame that stands for all: results must not depend on which of them are asked for."""

    @property
    def smoothing(self) -> float:
        """White samples behind each value of the range."""
        return 1.0

    @abstractmethod
    def fingerprint(self) -> dict[str, Any]:
        """What identifies the maps in a result's provenance."""

    def window(self, t: int, y0: int, x0: int, rows: int, cols: int) -> tuple[Array, Array]:
        """The part of ``frame`` from (y0, x0) on, NaN outside the image."""
        found = []
        for image in self.frame(t):
            out = np.full((rows, cols), np.nan)
            top, left = max(y0, 0), max(x0, 0)
            bottom, right = min(y0 + rows, image.shape[0]), min(x0 + cols, image.shape[1])
            if top < bottom and left < right:
                out[top - y0 : bottom - y0, left - x0 : right - x0] = image[top:bottom, left:right]
            found.append(out)
        return found[0], found[1]


@dataclass(eq=False)
class RangeFiles(GivenRange):
    """A stack [t, y, x] in memory (mapped from disk), or one file per frame."""

    path: str
    files: list[Path]
    stack: Array | None
    shape: tuple[int, int]
    noise: float = 0.0

    def frame(self, t: int) -> tuple[Array, Array]:
        """See ``GivenRange``."""
        depth = np.asarray(self.stack[t] if self.stack is not None else _read_map(self.files[t]), np.float64)
        if depth.shape != self.shape:
            found, wanted = (f"{s[1]} x {s[0]}" for s in (depth.shape, self.shape))
            raise InputError(f"{self.files[t]}: a range map of {found} pixels for images of {wanted}: make it the same")
        depth = np.where(np.isfinite(depth) & (depth > 0), depth, np.nan)
        return depth, np.where(np.isfinite(depth), self.noise, np.nan)

    @property
    def middle(self) -> int:
        """See ``GivenRange``."""
        return len(self.files) // 2

    def fingerprint(self) -> dict[str, Any]:
        """Names and sizes of the files, and the checksum of the first."""
        listing = "".join(f"{file.name}\0{file.stat().st_size}\n" for file in self.files)
        with self.files[0].open("rb") as first:
            digest = hashlib.file_digest(first, "sha256").hexdigest()
        return {"range_files_sha256": hashlib.sha256(listing.encode()).hexdigest(), "range_first_file_sha256": digest}


@dataclass(eq=False)
class RangeStore(GivenRange):
    """The depth of a results store, at stride 1."""

    path: str
    store: ResultStore
    shape: tuple[int, int]
    samples: float

    def __post_init__(self) -> None:
        self._read = lru_cache(maxsize=2)(self._whole)

    @property
    def middle(self) -> int:
        """See ``GivenRange``."""
        return self.store.frames[len(self.store.frames) // 2]

    @property
    def smoothing(self) -> float:
        """White samples in a window of the run that made the store."""
        return self.samples

    def _whole(self, t: int) -> tuple[Array, Array]:
        found = []
        for name in ("depth", "depth_std"):
            image = np.full(self.shape, np.nan)
            image[np.ix_(self.store.y, self.store.x)] = self.store.read(name, self.store.frames.index(t))
            found.append(image)
        return found[0], found[1]

    def frame(self, t: int) -> tuple[Array, Array]:
        """See ``GivenRange``."""
        return self._read(t)

    def fingerprint(self) -> dict[str, Any]:
        """What the store says of its own input and configuration."""
        attrs = self.store.attrs
        return {"range_store": {key: attrs.get(key) for key in ("config", "plan", "input")}}


def open_range(path: str, capture: Capture, frames: range) -> GivenRange:
    """The range maps that ``path`` names, for the frames that are needed.

    ``OUT.zarr``, a stack ``.npy`` or TIFF with one map per frame, or a pattern with ``{t}`` as in a capture.toml.
    Raises InputError where they are missing, not like the images, or too few; ConfigError for a bad pattern.
    """
    shape = (capture.height, capture.width)
    if Path(path).is_dir():
        return _open_store(path, shape, frames)
    try:
        pattern = Pattern.parse(path)
    except ValueError as error:
        raise ConfigError(f"range_flow.depth = {path!r}: {error}") from None
    if set(pattern.fields) - {"t"}:
        raise ConfigError(f"range_flow.depth = {path!r}: a range map has the field {{t}} alone")
    found = [
        (fields.get("t", 0), file) for fields, file in pattern.discover(Reach(Path(), outside=True)) if file.is_file()
    ]
    if not found:
        raise InputError(
            f"{path}: no such range maps: give a results store, a stack, or a pattern such as z_{{t:03d}}.tif"
        )
    stack = None
    if pattern.fields:
        numbers = dict(found)
        missing = [n for n in capture.frames if n not in numbers]
        if missing:
            raise InputError(
                f"{path}: {len(missing)} of {capture.n_frames} range maps are missing, first t = {missing[0]}"
            )
        files = [numbers[n] for n in capture.frames]
    else:
        files = [found[0][1]] * capture.n_frames
        stack = _open_stack(files[0], capture.n_frames)
    given = RangeFiles(path, files, stack, shape)
    depth, _ = given.frame(given.middle)
    if not np.isfinite(depth).any():
        raise InputError(
            f"{path}: the range map of frame {given.middle} has no finite, positive value: depths in mm are needed"
        )
    given.noise = max(white_noise(depth, False), FINEST_RANGE * float(np.nanmedian(depth)))
    return given


def _open_stack(file: Path, n_frames: int) -> Array:
    if file.suffix == ".npy":
        stack = _read_npy(file)
    else:
        stack = np.array([read_gray(file, page, dtype=np.float64) for page in range(probe(file).pages)])
    stack = stack[None] if stack.ndim == 2 else stack
    if stack.ndim != 3 or len(stack) != n_frames:
        raise InputError(f"{file}: {stack.shape} is no stack [t, y, x] of the capture's {n_frames} frames")
    return stack


def _read_npy(file: Path) -> Array:
    try:
        values: Array = np.load(file, mmap_mode="r")
    except (OSError, ValueError) as error:
        raise InputError(f"{file}: no .npy file of numbers ({error}): write it again") from None
    if values.dtype.kind not in "uif":
        raise InputError(f"{file}: range maps of type {values.dtype}: give depths in mm as floats")
    return values


def _read_map(file: Path) -> Array:
    return _read_npy(file) if file.suffix == ".npy" else read_gray(file, dtype=np.float64)


def _open_store(path: str, shape: tuple[int, int], frames: range) -> RangeStore:
    store = ResultStore.open(path)
    lacking = [name for name in ("depth", "depth_std") if name not in store.names]
    if lacking:
        raise InputError(f"{path}: has no map {lacking[0]!r}: run a model that measures depth into it")
    if max(np.diff(store.y, prepend=store.y[0] - 1).max(), np.diff(store.x, prepend=store.x[0] - 1).max()) > 1:
        raise InputError(f"{path}: range flow needs depth at every pixel: run with --stride 1")
    if store.y[-1] >= shape[0] or store.x[-1] >= shape[1]:
        raise InputError(
            f"{path}: reaches beyond the images of {shape[1]} x {shape[0]} pixels: give a run of this capture"
        )
    missing = [t for t in frames if t not in store.frames]
    if missing:
        raise InputError(
            f"{path}: frame {missing[0]} is missing, frames {frames.start}..{frames.stop - 1} are needed: run "
            "them with --model depth"
        )
    window = WindowSection.model_validate(tomllib.loads(store.attrs["config"])["window"])
    weights = gaussian_weights(window.size, window.sigma)
    return RangeStore(path, store, shape, float(1 / np.sum(weights**2) ** 2))
