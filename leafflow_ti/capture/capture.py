"""A capture: the images of a camera grid over time, read window by window.

Axes are ``t, sy, sx, y, x``: frame, camera row, camera column, pixel row (down), pixel column (right). Frames and
cameras are addressed by index from 0; the reference camera is ``(n_rows // 2, n_cols // 2)``, and ``k`` counts cameras
from it. Lengths are in mm, image positions in pixel with (0, 0) the centre of the first pixel. Grey values are those of
the files, or, with a calibration, those of the rectified images made of them, NaN where these show nothing.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from leafflow_ti.capture.channels import Array
from leafflow_ti.capture.description import Description
from leafflow_ti.capture.flaws import Flaws
from leafflow_ti.capture.images import checksum
from leafflow_ti.capture.lens import Lens
from leafflow_ti.capture.measured import FRACTION_DIGITS, LEAST_FRACTION, REACH, interpolated
from leafflow_ti.display import table_html

RESAMPLING_BYTES = 96
"""Of a pixel that is read between those of the image: positions, coefficients, sums (92 measured, with a lens)."""


@dataclass(frozen=True)
class Geometry:
    """Calibration of the grid; pairs are ``(x, y)``.

    ``f_px``: focal length [px]. ``principal_px``: principal point [px]. ``baseline_mm``: camera step for one index step
    [mm], 0 along an axis with one camera. ``disparity_offset_px``: added to the disparity seen in the images to give
    the total disparity [px/step]; same sign as nu, negative for images that were shifted towards each other.
    """

    f_px: float
    principal_px: tuple[float, float]
    baseline_mm: tuple[float, float] = (0.0, 0.0)
    disparity_offset_px: tuple[float, float] = (0.0, 0.0)

    def along_both(self, pair: tuple[float, float]) -> tuple[float, float]:
        """What holds per camera step, with that of the other axis for an axis that has one camera and so no step.

        A row's cameras that stand off along y are counted in its steps along x: a disparity is the same per mm.
        """
        x, y = pair
        return (x if self.baseline_mm[0] else y, y if self.baseline_mm[1] else x)


@dataclass(frozen=True, eq=False)
class Capture(ABC):
    """Lazy images ``[t, sy, sx, y, x]`` with their geometry; from files (``open_capture``) or from an array."""

    n_frames: int
    n_rows: int
    n_cols: int
    height: int
    width: int
    dtype: np.dtype[Any]
    """Type of the stored samples."""
    bits: int
    """Significant bits of a grey value."""
    geometry: Geometry | None
    """None for a single camera without calibration (optical flow in pixels only)."""
    frame_interval_s: float | None
    frames: tuple[int, ...]
    """Numbers of the frames in the file names."""
    description: Description | None = field(repr=False)
    path: Path | None
    """The ``capture.toml``, or None for an array."""
    positions_mm: npt.NDArray[np.float64] | None = field(repr=False)
    """Measured camera positions [rows, columns, (x, y)] relative to the reference camera; None: as ``baseline_mm``."""
    stamps_s: tuple[float, ...] | None = field(repr=False)
    """Measured time of each frame; None: one ``frame_interval_s`` after the other."""
    lenses: tuple[tuple[Lens, ...], ...] | None = field(default=None, repr=False, kw_only=True)
    """For each camera row and column the lens whose distortion is taken out; None: images are taken as they are."""
    flaws: Flaws | None = field(default=None, repr=False, kw_only=True)
    """Pixels that are read as NaN."""
    outside: bool = field(default=False, repr=False, kw_only=True)
    """Whether its files may lie outside the folder of its description: who opens it again must allow that, too."""

    def _repr_html_(self) -> str:
        rows = [
            ("frames", str(self.n_frames)),
            ("interval", "not stated" if self.frame_interval_s is None else f"{self.frame_interval_s:g} s"),
            ("cameras", f"{self.n_rows} x {self.n_cols} (rows, columns)"),
            ("images", f"{self.width} x {self.height} px, {self.bits} bit in {self.dtype}"),
        ]
        if self.geometry is not None:
            steps = ", ".join(f"{step:g}" for step in self.geometry.baseline_mm)
            rows += [("focal length", f"{self.geometry.f_px:g} px"), ("camera step", f"{steps} mm (x, y)")]
        return f"<div><p><b>Capture</b></p>{table_html((), rows)}</div>"

    @property
    def finite(self) -> bool:
        """Whether every grey value inside the images is known to be a number."""
        return self.dtype.kind in "bui" and self.lenses is None and self.flaws is None

    @property
    def reference(self) -> tuple[int, int]:
        """Row and column of the reference camera."""
        return self.n_rows // 2, self.n_cols // 2

    @property
    def shape(self) -> tuple[int, int, int, int, int]:
        """``(n_frames, n_rows, n_cols, height, width)``."""
        return self.n_frames, self.n_rows, self.n_cols, self.height, self.width

    @property
    def camera_steps(self) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """Where the cameras stand: x and y [rows, columns], in nominal steps from the reference."""
        row0, col0 = self.reference
        if self.positions_mm is None or self.geometry is None:
            y, x = np.meshgrid(np.arange(self.n_rows) - row0, np.arange(self.n_cols) - col0, indexing="ij")
            return x.astype(np.float64), y.astype(np.float64)
        x_mm, y_mm = self.geometry.along_both(self.geometry.baseline_mm)
        return self.positions_mm[..., 0] / x_mm, self.positions_mm[..., 1] / y_mm

    @property
    def frame_times(self) -> tuple[float, ...]:
        """Time of each frame in nominal intervals from the first one."""
        if self.stamps_s is None or self.frame_interval_s is None:
            return tuple(float(t) for t in range(self.n_frames))
        return tuple((s - self.stamps_s[0]) / self.frame_interval_s for s in self.stamps_s)

    def shifts(self, shift_px: tuple[float, float]) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
        """By how many pixels each camera's image is read shifted, y and x [rows, columns]; ``shift_px``: (x, y) per
        nominal step. Where positions are measured they are no whole numbers."""
        x, y = self.camera_steps
        if self.positions_mm is not None and self.geometry is not None:
            shift_px = self.geometry.along_both(shift_px)
        return shift_px[1] * y, shift_px[0] * x

    def pixels_read(
        self, shift_px: tuple[float, float]
    ) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], npt.NDArray[np.int64], npt.NDArray[np.int64]]:
        """What of its images a pixel at 0 is made of: first and last row for each camera row, first and last column
        for each camera column; interpolation included."""
        found = []
        for shifts, across in zip(self.shifts(shift_px), (1, 0), strict=True):
            near = np.round(shifts)
            more = np.where(np.abs(shifts - near) > LEAST_FRACTION, REACH, 0)
            found += [(near - more).min(axis=across), (near + more).max(axis=across)]
        first_y, last_y, first_x, last_x = (f.astype(np.int64) for f in found)
        return first_y, last_y, first_x, last_x

    def _measured(self) -> dict[str, Any]:
        """Measured positions and stamps, and flawed pixels, for the fingerprint."""
        found: dict[str, Any] = {}
        if self.positions_mm is not None:
            found["positions_mm"] = self.positions_mm.round(9).tolist()
        if self.stamps_s is not None:
            found["stamps_s"] = list(self.stamps_s)
        if self.flaws and self.flaws.saturated is not None:
            found["saturated"] = self.flaws.saturated
        if self.flaws and self.flaws.files:
            found["dead_sha256"] = [checksum(path) for path in self.flaws.files]
        return found

    @abstractmethod
    def _window(self, t: int, sy: int, sx: int, y0: int, y1: int, x0: int, x1: int) -> Array:
        """Non-empty window inside the image, in any type; the caller does not write to it."""

    def stored_rows(self, t: int, sy: int, sx: int, y0: int, y1: int) -> Array:
        """Rows ``y0`` to ``y1`` inside one image as they are stored, whatever is made of them; do not write to it.

        Raises InputError if the file cannot be decoded.
        """
        return self._window(t, sy, sx, y0, y1, 0, self.width)

    @property
    def reads_windows(self) -> bool:
        """Whether a part of an image costs less than the whole."""
        return True

    def image_name(self, t: int, sy: int, sx: int) -> str:
        """What to call one image in a message."""
        return f"frame {t}, camera row {sy}, column {sx}"

    def reading_bytes(self, rows: int, cols: int) -> int:
        """Memory that reading a window of one image takes for the time being, beside the window itself."""
        resampled = 0 if self.lenses is None and self.positions_mm is None else RESAMPLING_BYTES
        return resampled * rows * cols + self._decoding_bytes(rows, cols)

    def _decoding_bytes(self, rows: int, cols: int) -> int:
        """Of that, what the stored samples take; none where the image is in memory."""
        return 0

    @property
    def cacheable_bytes(self) -> int:
        """Memory that spares decoding an image for each of its windows, if all images are kept; 0: none does."""
        return 0

    def keep_decoded(self, n_bytes: int) -> None:  # noqa: B027 - most captures keep nothing
        """Keep decoded images of at most so many bytes from now on."""

    @property
    def listing(self) -> str | None:
        """Names, sizes and times of the files, for ``changes``; None for a capture without files."""
        return None

    def frames_of(self, name: str) -> set[int]:
        """Frames of which a file, named as in the listing, holds images; none for a file that is not of the capture."""
        return set()

    @abstractmethod
    def fingerprint(self, contents: bool = True) -> dict[str, Any]:
        """What identifies the input in a result's provenance; with or without checksums of grey values."""

    def read(
        self, t: int, sy: int, sx: int, y0: int, y1: int, x0: int, x1: int, dtype: npt.DTypeLike = np.float32
    ) -> Array:
        """Window ``[y1-y0, x1-x0]`` of one image, as a floating type; what lies outside the image is 0.

        Raises InputError if the file cannot be decoded, IndexError for a frame or camera that does not exist.
        """
        out = np.zeros((y1 - y0, x1 - x0), dtype)
        self._read_into(out, t, sy, sx, y0, x0)
        return out

    def block(
        self,
        frames: Sequence[int],
        rows: Sequence[int],
        cols: Sequence[int],
        y0: int,
        y1: int,
        x0: int,
        x1: int,
        shift_px: tuple[int, int] = (0, 0),
        dtype: npt.DTypeLike = np.float32,
    ) -> Array:
        """Preshifted windows ``[t, sy, sx, y1-y0, x1-x0]`` of the given frames, camera rows and columns.

        With ``(nx, ny) = shift_px`` and a camera ``(kx, ky)`` steps from the reference, block pixel ``(x', y')`` is
        image pixel ``(x' + nx kx, y' + ny ky)``: the integer preshift nu0 of model section 1. Outside the images: 0.
        Where positions are measured, k is the camera's true place in steps, and images are interpolated: what is left
        of the disparity is then in proportion to it, like everything that filters along the cameras rely on.
        """
        out = np.zeros((len(frames), len(rows), len(cols), y1 - y0, x1 - x0), dtype)
        for fill in self.fills(out, frames, rows, cols, y0, x0, shift_px):
            fill()
        return out

    def fills(
        self,
        out: Array,
        frames: Sequence[int],
        rows: Sequence[int],
        cols: Sequence[int],
        y0: float,
        x0: float,
        shift_px: tuple[int, int] = (0, 0),
    ) -> Iterator[Callable[[], None]]:
        """The work of ``block``, image by image, for threads to share: each call fills its image of ``out``.

        ``out`` [t, sy, sx, rows, columns] is zero before; the order is that of its images.
        """
        shift_y, shift_x = self.shifts(shift_px)
        for i, t in enumerate(frames):
            for j, sy in enumerate(rows):
                for k, sx in enumerate(cols):
                    place = y0 + float(shift_y[sy, sx]), x0 + float(shift_x[sy, sx])
                    yield partial(self._read_at, out[i, j, k], t, sy, sx, *place)

    def _sound(self, t: int, sy: int, sx: int, y0: int, y1: int, x0: int, x1: int) -> Array:
        """The same as ``_window`` without flawed pixels."""
        window = self._window(t, sy, sx, y0, y1, x0, x1)
        return window if self.flaws is None else self.flaws.without(window, sy, sx, y0, x0)

    def _read_at(self, out: Array, t: int, sy: int, sx: int, top: float, left: float) -> None:
        """The same as ``_read_into`` at a place between pixels. Images are interpolated once: with a lens, where that
        takes out its distortion."""
        corner = math.floor(top + LEAST_FRACTION), math.floor(left + LEAST_FRACTION)
        # Rounded: the same bits wherever a window begins.
        fraction = round(top - corner[0], FRACTION_DIGITS), round(left - corner[1], FRACTION_DIGITS)
        if max(fraction) < LEAST_FRACTION:
            self._read_into(out, t, sy, sx, *corner)
            return
        if self.lenses is not None:
            self._read_into(out, t, sy, sx, *corner, fraction)
            return
        around = np.zeros([n + 2 * REACH for n in out.shape], out.dtype)
        self._read_into(around, t, sy, sx, corner[0] - REACH, corner[1] - REACH)
        out[...] = interpolated(around, fraction)

    def _read_into(
        self, out: Array, t: int, sy: int, sx: int, top: int, left: int, fraction: tuple[float, float] = (0.0, 0.0)
    ) -> None:
        """Copy the part of a window that lies inside the image; ``out`` is zero before. With lenses it may begin
        ``fraction`` (y, x) of a pixel behind its corner."""
        for name, index, count in (("frame", t, self.n_frames), ("row", sy, self.n_rows), ("column", sx, self.n_cols)):
            if not 0 <= index < count:
                raise IndexError(f"{name} {index} does not exist: the capture has 0 to {count - 1}")
        beyond_y, beyond_x = (int(part > 0) for part in fraction)  # the last pixel has no next one
        y0, y1 = max(top, 0), min(top + out.shape[0], self.height - beyond_y)
        x0, x1 = max(left, 0), min(left + out.shape[1], self.width - beyond_x)
        if y0 >= y1 or x0 >= x1:
            return
        inside = out[y0 - top : y1 - top, x0 - left : x1 - left]
        if self.lenses is None:
            inside[...] = self._sound(t, sy, sx, y0, y1, x0, x1)
        else:
            size, read = (self.height, self.width), partial(self._sound, t, sy, sx)
            self.lenses[sy][sx].rectify(inside, y0, x0, size, read, fraction)
