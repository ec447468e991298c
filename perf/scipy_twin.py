"""A straightforward SciPy/NumPy implementation of the same estimate, timed for comparison.

``correlate1d`` for filters and moment windows, ``tensordot`` for the sums over cameras and frames,
``numpy.linalg.eigh`` for the null space. It ends at the flow parameters: error bars and the 3D fit, which the
library's last stage includes, are left out.
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import correlate1d  # type: ignore[import-untyped]

from leafflow_ti.models import AXES, ColumnSet, Moment, TensorLayout
from leafflow_ti.sampling import Sampling, column_noise

Array = NDArray[np.float64]
PLACE = {"t": 0, "sy": 1, "sx": 2, "y": 3, "x": 4}


@dataclass(frozen=True)
class TwinResult:
    """Flow parameters [rows, cols, k, n_flow] of the crop, and seconds of each stage per pixel that it worked on."""

    parameters: Array
    products: float
    windows_y: float
    windows_x: float
    null_space: float


def estimate(images: NDArray[np.float32], columns: ColumnSet, layout: TensorLayout, sampling: Sampling) -> TwinResult:
    """Estimate every pixel whose whole window lies inside ``images`` [t, sy, sx, y, x], for the middle camera and
    frame."""
    began = time.perf_counter()
    maps = _products(images, columns, layout, sampling)
    after_products = time.perf_counter()
    tall = {}
    for moment in layout.moments:
        key, n = _key(moment), moment.exponents[AXES.index("y")]
        if (key, n) not in tall:
            tall[key, n] = _valid(correlate1d(maps[key], sampling.y.window(n), axis=0), 0, sampling.y.size // 2)
    after_y = time.perf_counter()
    planes = []
    for entry in layout.entries:
        plane = np.zeros(())
        for moment, factor in entry:
            window = factor * sampling.x.window(moment.exponents[AXES.index("x")])
            plane = plane + correlate1d(tall[_key(moment), moment.exponents[AXES.index("y")]], window, axis=1)
        planes.append(_valid(plane, 1, sampling.x.size // 2))
    after_x = time.perf_counter()
    parameters = _null_space(np.stack(planes, axis=-1), columns, layout, sampling)
    after_null_space = time.perf_counter()
    high, wide = next(iter(maps.values())).shape
    rows, cols = planes[0].shape
    return TwinResult(
        parameters,
        (after_products - began) / (high * wide),
        (after_y - after_products) / (rows * wide),
        (after_x - after_y) / (rows * cols),
        (after_null_space - after_x) / (rows * cols),
    )


def _key(moment: Moment) -> tuple[tuple[str, str], tuple[int, ...]]:
    """A product image summed over cameras and frames: its channels and the powers of t, sy, sx."""
    return moment.channels, tuple(moment.exponents[AXES.index(a)] for a in ("t", "sy", "sx"))


def _valid(image: Array, axis: int, radius: int) -> Array:
    return np.take(image, range(radius, image.shape[axis] - radius), axis=axis)


def _products(
    images: NDArray[np.float32], columns: ColumnSet, layout: TensorLayout, sampling: Sampling
) -> dict[object, Array]:
    channels = {}
    for channel in columns.channels:
        out = images.astype(np.float64)
        for axis, place in PLACE.items():
            if sampling.axis(axis).filters:
                out = correlate1d(out, sampling.axis(axis).kernel(channel == axis), axis=place)
        for axis, place in PLACE.items():
            out = _valid(out, place, sampling.axis(axis).filter_radius)
        channels[channel] = out
    maps: dict[object, Array] = {}
    for pair in {moment.channels for moment in layout.moments}:
        product = channels[pair[0]] * channels[pair[1]]
        for moment in layout.moments:
            key = _key(moment)
            if moment.channels == pair and key not in maps:
                weight = np.ones(())
                for axis, power in zip(("t", "sy", "sx"), key[1], strict=True):
                    weight = np.multiply.outer(weight, sampling.axis(axis).window(power))
                maps[key] = np.tensordot(weight, product, axes=3)
    return maps


def _null_space(packed: Array, columns: ColumnSet, layout: TensorLayout, sampling: Sampling) -> Array:
    """Equilibrated total least squares, combined so that one time-like differential is 1 and the others 0."""
    n, flow = columns.n, columns.n_flow
    rows, cols = np.tril_indices(n)
    tensor = np.empty((*packed.shape[:2], n, n))
    tensor[..., rows, cols] = tensor[..., cols, rows] = packed[..., list(layout.lower)]
    scale = column_noise(sampling, columns) ** -0.5
    vectors = np.linalg.eigh(tensor * np.multiply.outer(scale, scale))[1][..., : columns.n_time_like] * scale[:, None]
    combined = vectors[..., :flow, :] @ np.linalg.inv(vectors[..., flow:, :])
    return np.asarray(np.swapaxes(combined, -1, -2))
