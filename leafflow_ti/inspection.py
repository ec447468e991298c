"""Whether a capture can be measured, and what to change: cameras, light, noise, texture, disparities, motions.

A few frames and all cameras are looked at. Every finding is a number with its standard error, where it has one, and a
sentence where something should be done.
"""

from __future__ import annotations

import math
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.capture import Capture, capture_doubts, open_capture
from leafflow_ti.capture.plausibility import depth_doubts
from leafflow_ti.errors import InputError
from leafflow_ti.inspection_advice import advice
from leafflow_ti.inspection_report import Advice, CameraCheck, Report
from leafflow_ti.matching import Templates, choose_points
from leafflow_ti.noise import white_noise
from leafflow_ti.photometry import defects, saturated, texture_of
from leafflow_ti.positions import Positions, fit_positions
from leafflow_ti.runtime import start
from leafflow_ti.search import Coarse, Extent, coarse_search

Floats = NDArray[np.float64]

WINDOW = 65
"""Window of the texture's judgement [px]: the default of ``run``."""
FRAMES = 3
"""Frames of which all cameras are read."""
KEPT_IMAGES = 64
"""Images kept in memory while they are compared."""
TAILS = (1.0, 99.0)
"""Percentiles that stand for the range of disparities and motions."""


def check(capture: Capture | str | Path) -> Report:
    """Look at a few frames of a capture. Raises InputError where images cannot be read, DeviceError."""
    if not isinstance(capture, Capture):
        capture = open_capture(capture)
    return _Check(capture).report()


class _Check:
    """The images that are looked at, and what follows from them."""

    def __init__(self, capture: Capture):
        self.capture = capture
        self.frames = sorted({round(t) for t in np.linspace(0, capture.n_frames - 1, min(FRAMES, capture.n_frames))})
        self.frame = capture.n_frames // 2
        self.cameras = [(row, col) for row in range(capture.n_rows) for col in range(capture.n_cols)]
        self.image = lru_cache(KEPT_IMAGES)(self._image)

    def _image(self, t: int, row: int, col: int) -> NDArray[np.float32]:
        """Grey values, NaN where they are no numbers: infinite ones say no more."""
        image = self.capture.read(t, row, col, 0, self.capture.height, 0, self.capture.width)
        image[np.isinf(image)] = np.nan
        return np.asarray(image, np.float32)

    def report(self) -> Report:
        """Everything, then what it means."""
        capture, reference = self.capture, self.capture.reference
        middle = np.asarray(self.image(self.frame, *reference), np.float64)
        if not np.isfinite(middle).any():
            raise InputError(
                f"{capture.image_name(self.frame, *reference)}: no grey value is a number: check the images"
            )
        noise = white_noise(middle, capture.dtype.kind in "bui")
        texture = texture_of(middle, noise, WINDOW)
        coarse = self._coarse()
        places, gains = self._matched(middle, noise, coarse) if coarse else (None, {})
        cameras = tuple(self._camera(k, places, gains) for k in range(len(self.cameras)))
        broken = defects([np.asarray(self.image(*key), np.float64) for key in self._one_sensor()], noise)
        line = places.linear[1, 0] if places and capture.n_cols > 1 else None
        found = Report(
            cameras,
            None if places is None or not np.isfinite(places.measured_mm).all() else tuple(
                (float(x), float(y)) for x, y in places.measured_mm - places.measured_mm[0]
            ),
            None if line is None or places is None else (1e3 * float(line), 1e3 * float(places.linear_error[1, 0])),
            places.residual_px if places else None,
            int(places.seen.max()) if places else 0,
            self._frame_gains(),
            noise,
            texture,
            tuple((int(row), int(col)) for row, col in broken),
            _range(coarse.disparity[coarse.known]) if coarse and len(self.cameras) > 1 and coarse.known.any() else None,
            float(np.percentile(np.hypot(*coarse.motion)[coarse.known], TAILS[1]))
            if coarse and capture.n_frames > 1 and coarse.known.any() else None,
            (),
        )  # fmt: skip
        doubts = tuple(Advice("problem", text) for text in self._doubts(found))
        return replace(found, advice=(*doubts, *advice(found, capture, places)))

    def _doubts(self, found: Report) -> list[str]:
        """What a run would warn of, and depths that can hardly be meant."""
        doubts = list(capture_doubts(self.capture))
        if found.disparity_px is not None:
            middle = sum(found.disparity_px) / 2
            doubts += depth_doubts(self.capture, (middle, 0.0) if self.capture.n_cols > 1 else (0.0, middle))
        return doubts

    def _coarse(self) -> Coarse | None:
        """Disparities and motions of every pixel of the reference camera's middle frame; None: nothing to compare."""
        capture = self.capture
        if len(self.cameras) == 1 and capture.n_frames == 1:
            return None
        geometry = capture.geometry
        baseline = (1.0, 1.0) if geometry is None else (geometry.baseline_mm[0] or 1.0, geometry.baseline_mm[1] or 1.0)
        offset = (0.0, 0.0) if geometry is None else geometry.disparity_offset_px
        extent = Extent(
            capture.n_frames, capture.n_rows, capture.n_cols, capture.height, capture.width, baseline, offset,
            capture.frame_times,
        )  # fmt: skip
        device = start("auto", "f32")
        return coarse_search(device, self.image, extent, reference=capture.reference, frame=self.frame,
                             moving=capture.n_frames > 1)  # fmt: skip

    def _matched(
        self, middle: Floats, noise: float, coarse: Coarse
    ) -> tuple[Positions | None, dict[int, tuple[float, float, float]]]:
        """Positions of the cameras, and gain, its error and offset of each against the reference."""
        capture, geometry = self.capture, self.capture.geometry
        if geometry is None or len(self.cameras) < 3:
            return None, {}
        points = choose_points(middle, noise, coarse.known)
        templates = Templates(middle, points, noise)
        row0, col0 = capture.reference
        steps = np.array([(col - col0, row - row0) for row, col in self.cameras], float)
        nominal, offset = steps * np.array(geometry.baseline_mm), steps * np.array(geometry.disparity_offset_px)
        stated = nominal if capture.positions_mm is None else capture.positions_mm.reshape(-1, 2)
        axis = 0 if capture.n_cols > 1 else 1
        seen = coarse.disparity[points[:, 0], points[:, 1]].astype(float)
        q = -(seen + geometry.disparity_offset_px[axis]) / geometry.baseline_mm[axis]
        reference = self.cameras.index((row0, col0))
        places = np.zeros((len(steps), len(points), 2))
        ok = np.zeros(places.shape[:2], bool)
        ok[reference] = True
        gains: dict[int, tuple[float, float, float]] = {}
        for k in np.argsort(np.abs(nominal).sum(axis=1), kind="stable").tolist():
            if k == reference:
                continue
            found = templates.find(
                np.asarray(self.image(self.frame, *self.cameras[k]), np.float64), -q[:, None] * stated[k] - offset[k]
            )
            places[k], ok[k] = found.shift + offset[k], found.ok
            # The nearer cameras say where the next ones will show the point.
            lever = np.sum(ok[..., None] * stated[:, None] ** 2, axis=(0, 2))
            better = -np.einsum("kn,knj,kj->n", ok, places, stated) / np.maximum(lever, 1e-30)
            q = np.where(lever > 0, better, q)
            if found.ok.sum() > 2:
                gains[k] = _gain(found.gain[found.ok], found.grey[found.ok], templates.grey[found.ok])
        principal = np.array(geometry.principal_px)
        return fit_positions(places, ok, points[:, ::-1] - principal, nominal, reference, stated), gains

    def _camera(self, k: int, places: Positions | None, gains: dict[int, tuple[float, float, float]]) -> CameraCheck:
        row, col = self.cameras[k]
        images = [np.asarray(self.image(t, row, col), np.float64) for t in self.frames]
        largest = 2.0**self.capture.bits - 1 if self.capture.dtype.kind in "bui" else math.inf
        noise = white_noise(images[len(images) // 2], self.capture.dtype.kind in "bui")
        known = places is not None and bool(np.isfinite(places.off_mm[k]).all())
        gain, gain_error, offset = gains.get(k, (None, None, None))
        off = error = roll = None
        if places is not None and known:
            off = (1e3 * float(places.off_mm[k, 0]), 1e3 * float(places.off_mm[k, 1]))
            error = (1e3 * float(places.error_mm[k, 0]), 1e3 * float(places.error_mm[k, 1]))
            roll = (1e3 * float(places.roll[k]), 1e3 * float(places.roll_error[k]))
        share = float(np.mean([saturated(image, largest) for image in images]))
        return CameraCheck(row, col, off, error, roll, gain, gain_error, offset, noise, share)

    def _one_sensor(self) -> list[tuple[int, int, int]]:
        """Images among which the scene moves over the sensor: all cameras of a grid, or the frames of one camera."""
        return [(self.frame, *camera) for camera in self.cameras] if len(self.cameras) > 1 else [
            (t, 0, 0) for t in sorted({round(t) for t in np.linspace(0, self.capture.n_frames - 1, 9)})
        ]  # fmt: skip

    def _frame_gains(self) -> dict[int, float]:
        """Mean grey values of some frames of the reference camera over that of the middle one; of those with any."""
        reference, means = self.capture.reference, dict[int, float]()
        for t in sorted({*self.frames, self.frame}):
            image = self.image(t, *reference)
            known = np.isfinite(image)
            if known.any():
                means[t] = float(np.mean(image, where=known))
        return {t: mean / means[self.frame] for t, mean in means.items()} if means[self.frame] else {}


def _range(values: NDArray[Any]) -> tuple[float, float]:
    low, high = np.percentile(values, TAILS)
    return float(low), float(high)


def _gain(gains: Floats, greys: Floats, wanted: Floats) -> tuple[float, float, float]:
    """Gain, its standard error, and offset [grey values] of windows against the reference's."""
    gain = float(np.median(gains))
    error = 1.4826 * float(np.median(np.abs(gains - gain))) * math.sqrt(math.pi / 2 / len(gains))
    return gain, error, float(np.median(greys - gain * wanted))
