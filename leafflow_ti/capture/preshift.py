"""Integer disparity per camera step, found from the images.

Sign as in model section 1: the camera one step to +x shows a point at ``x + nu``; ``nu`` is negative for a positive
baseline and a point in front of the cameras. Band-passed images of camera pairs are correlated along the grid axis,
each lag normalised by its own overlap (so that small lags are not favoured), and the correlations of all pairs are
summed. Neighbours give the disparity without ambiguity of the step, pairs further apart then refine it.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from leafflow_ti.capture.capture import Capture
from leafflow_ti.errors import InputError

_MAX_CROP = 1024  # pixels of the middle of the image that are compared
_MIN_SIZE = 16
_BAND_PX = (1.0, 10.0)  # standard deviations of the Gaussians whose difference is the band pass
_LEAST_KNOWN = 1e-3  # share of a neighbourhood of which a mean is formed
_CROSS_PX = 2  # misalignment across the grid axis that is tolerated
CLEAR = 0.3
"""Correlation of a clear peak; independent noise stays below 0.15."""
_REPEAT = 0.7  # an image that resembles itself elsewhere this well, relative to its neighbour, repeats itself
_FRAMES, _LINES, _PAIRS = 2, 3, 4  # images that are compared: frames, camera lines, pairs per line

_Image = npt.NDArray[np.float64]
_WAY_OUT = "give it with --preshift X,Y"


class UnclearDisparity(InputError):
    """Neighbouring cameras do not show the same at any one shift."""


def find_preshift(capture: Capture) -> tuple[int, int]:
    """Integer disparity ``(nx, ny)`` [px/step] that leaves the smallest residual; 0 along an axis without grid.

    A scene with surfaces at several depths gives that of the surface with most texture. Raises InputError if the images
    have no texture, do not correlate, repeat themselves, or move against the sign of the baseline.
    """
    nx = _along(capture, "x") if capture.n_cols > 1 else 0.0
    ny = _along(capture, "y") if capture.n_rows > 1 else 0.0
    return round(nx), round(ny)


def _along(capture: Capture, axis: str) -> float:
    """Disparity per step along one grid axis, with its fraction."""
    load = Loader(capture, axis)
    count = capture.n_cols if axis == "x" else capture.n_rows
    nu = _neighbour_peak(capture, axis, load)
    reach = 1
    while reach < count - 1:
        wider = min(2 * reach, count - 1)
        curve = correlation(load, _pairs(capture, axis, wider))
        window = int(np.ceil(0.75 * wider / reach))
        middle, zero = round(nu * wider), len(curve) // 2
        if abs(middle) + window >= zero:
            break  # the wider pair hardly overlaps any more
        part = curve[zero + middle - window : zero + middle + window + 1]
        lag = middle - window + int(np.argmax(part))
        if curve[zero + lag] < CLEAR or abs(lag - middle) == window:
            break  # other surfaces take over, the nearer cameras have the better answer
        nu, reach = (lag + _vertex(curve, zero + lag)) / wider, wider
    return nu


def _neighbour_peak(capture: Capture, axis: str, load: Callable[[_Key], _Image]) -> float:
    """Lag of the clear peak between neighbours, once repetition and a wrong order of the cameras are excluded."""
    curve = correlation(load, _pairs(capture, axis, 1))
    zero = len(curve) // 2
    peaks = _maxima(curve)
    height = curve[peaks].max(initial=0.0)
    if height < CLEAR:
        raise UnclearDisparity(
            f"no clear disparity along {axis}: neighbours correlate by {height:.2f}, {CLEAR} is needed: {_WAY_OUT}"
        )
    itself = correlation(load, ((one, one) for one, _ in _pairs(capture, axis, 1)))
    elsewhere = _maxima(itself)
    elsewhere = elsewhere[elsewhere != zero]
    if itself[elsewhere].max(initial=0.0) >= _REPEAT * height:
        period = abs(int(elsewhere[np.argmax(itself[elsewhere])]) - zero)
        raise InputError(
            f"the texture repeats every {period} px along {axis}, so that several disparities fit: {_WAY_OUT}"
        )
    peak = int(peaks[np.argmax(curve[peaks])])
    if not _in_front(capture, axis, peak - zero):
        raise UnclearDisparity(
            f"images shift by {peak - zero:+d} px per step along {axis}, against the sign of baseline_mm: "
            f"correct the baseline's sign or the order of the cameras, or {_WAY_OUT}"
        )
    return peak - zero + _vertex(curve, peak)


def _maxima(curve: _Image) -> npt.NDArray[np.intp]:
    """Indices of the inner local maxima."""
    inner = curve[1:-1]
    return 1 + np.flatnonzero((inner >= curve[:-2]) & (inner > curve[2:]))


def _in_front(capture: Capture, axis: str, lag: int) -> bool:
    """Whether the total disparity has the sign of a point in front of the cameras, within a pixel."""
    if capture.geometry is None:
        return True
    k = 0 if axis == "x" else 1
    baseline, offset = capture.geometry.baseline_mm[k], capture.geometry.disparity_offset_px[k]
    return (lag + offset) * float(np.sign(baseline)) <= 1.0


@dataclass
class Loader:
    """Band-passed middles of images, the grid axis last; each image is prepared once.

    ``across``: most pixels across the grid axis, of ``_MAX_CROP`` along both.
    """

    capture: Capture
    axis: str
    across: int = _MAX_CROP

    def __post_init__(self) -> None:
        self._kept: dict[tuple[int, int, int], _Image] = {}

    def __call__(self, key: tuple[int, int, int]) -> _Image:
        if key not in self._kept:
            most = (self.across, _MAX_CROP) if self.axis == "x" else (_MAX_CROP, self.across)
            height, width = min(self.capture.height, most[0]), min(self.capture.width, most[1])
            y0, x0 = (self.capture.height - height) // 2, (self.capture.width - width) // 2
            image = self.capture.read(*key, y0, y0 + height, x0, x0 + width, dtype=np.float64)
            self._kept[key] = _band_pass(image if self.axis == "x" else image.T)
        return self._kept[key]


_Key = tuple[int, int, int]  # t, sy, sx


def _pairs(capture: Capture, axis: str, reach: int) -> Iterator[tuple[_Key, _Key]]:
    """Camera pairs ``reach`` steps apart: a few frames, lines and places, evenly spread."""
    along, across = (capture.n_cols, capture.n_rows) if axis == "x" else (capture.n_rows, capture.n_cols)
    spread = itertools.product(
        _spread(capture.n_frames, _FRAMES), _spread(across, _LINES), _spread(along - reach, _PAIRS)
    )
    for t, line, start in spread:
        if axis == "x":
            yield (t, line, start), (t, line, start + reach)
        else:
            yield (t, start, line), (t, start + reach, line)


def _spread(count: int, wanted: int) -> list[int]:
    return sorted({round(k) for k in np.linspace(0, count - 1, min(count, wanted))})


def _band_pass(image: _Image) -> _Image:
    """Difference of two Gaussians, without trend and pixel noise; zero for an image without texture."""
    if min(image.shape) < _MIN_SIZE:
        raise InputError(
            f"images of {min(image.shape)} px are too small to find a disparity, {_MIN_SIZE} px: {_WAY_OUT}"
        )
    known = np.isfinite(image)
    if not known.any():
        raise InputError(f"images hold no grey values that are finite, no disparity can be found: {_WAY_OUT}")
    grey = np.where(known, image - image[known].mean(), 0.0)
    margin = int(2 * _BAND_PX[1])
    shape = (image.shape[0] + 2 * margin, image.shape[1] + 2 * margin)
    fy = np.fft.fftfreq(shape[0])[:, None]
    fx = np.fft.rfftfreq(shape[1])[None, :]

    responses = [np.exp(-2 * (np.pi * sigma) ** 2 * (fy**2 + fx**2)) for sigma in _BAND_PX]

    def filtered(values: _Image, response: _Image) -> _Image:
        spectrum = np.fft.rfft2(np.pad(values, margin, mode="symmetric"))
        return np.asarray(np.fft.irfft2(spectrum * response, shape)[margin:-margin, margin:-margin])

    if known.all():
        result = filtered(grey, responses[0] - responses[1])
    else:
        # Means over what is known of a neighbourhood; far from it there is nothing to divide.
        narrow, wide = (
            filtered(grey, response) / np.maximum(filtered(known.astype(float), response), _LEAST_KNOWN)
            for response in responses
        )
        result = np.where(known, narrow - wide, 0.0)
    if result.std() <= 1e-9 * max(1.0, float(np.abs(image[known]).max())):
        return np.zeros_like(image)
    return result


def correlation(load: Callable[[_Key], _Image], pairs: Iterable[tuple[_Key, _Key]]) -> _Image:
    """Normalised correlation for lags ``-W/2 .. W/2`` along the last axis, summed over pairs, best misalignment."""
    total: npt.NDArray[np.float64] = np.zeros(())
    for one, other in pairs:
        total = total + _products(load(one), load(other))
    cross, energy_a, energy_b = np.moveaxis(total, 1, 0)
    energy = np.sqrt(energy_a * energy_b)
    ratio = np.divide(cross, energy, out=np.zeros_like(cross), where=energy > 0)
    return np.asarray(ratio.max(axis=0))


def _products(a: _Image, b: _Image) -> _Image:
    """``[cross lag, (a b, a a, b b), lag]``: sums over the overlap of ``a(x)`` and ``b(x + lag)``."""
    height, width = a.shape
    lags = np.arange(-(width // 2), width // 2 + 1)
    spectrum_a, spectrum_b = np.fft.rfft(a, 2 * width), np.fft.rfft(b, 2 * width)
    rows = []
    for dy in range(-_CROSS_PX, _CROSS_PX + 1):
        of_a, of_b = slice(max(0, -dy), height - max(0, dy)), slice(max(0, dy), height + min(0, dy))
        cross = np.fft.irfft((spectrum_a[of_a].conj() * spectrum_b[of_b]).sum(axis=0), 2 * width)[lags]
        sum_a = np.concatenate([[0.0], np.cumsum((a[of_a] ** 2).sum(axis=0))])
        sum_b = np.concatenate([[0.0], np.cumsum((b[of_b] ** 2).sum(axis=0))])
        first_a, last_a = np.maximum(0, -lags), width - np.maximum(0, lags)
        energy_a = sum_a[last_a] - sum_a[first_a]
        energy_b = sum_b[last_a + lags] - sum_b[first_a + lags]
        rows.append(np.stack([cross, energy_a, energy_b]))
    return np.stack(rows)


def _vertex(curve: _Image, k: int) -> float:
    """Offset, within half a sample, of the vertex of the parabola through a maximum and its neighbours."""
    left, middle, right = curve[k - 1 : k + 2]
    bend = left - 2 * middle + right
    return float(np.clip(0.5 * (left - right) / bend, -0.5, 0.5)) if bend < 0 else 0.0
