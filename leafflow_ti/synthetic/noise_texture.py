"""Band-limited random textures: periodic fields made in the Fourier domain, read by bilinear interpolation.

The table samples the shortest wavelength so finely that interpolation changes the field by 0.3 % at most.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.errors import UsageError
from leafflow_ti.synthetic.geometry import Array

SAMPLES_PER_WAVELENGTH = 40
MAX_TABLE = 8192
MOST_FIELDS = 24
"""Fields that are kept: those of all surfaces of a scene, which are read in turn."""

PERIOD = 64
"""After so many of its shortest wavelengths the noise of a surface without borders repeats itself."""

DARKEST = 1.0
"""Lowest albedo in grey values: no point of a surface is black, logarithms of the images stay finite."""


@lru_cache(maxsize=MOST_FIELDS)
def noise_texture(seed: tuple[int, ...], period: float, shortest: float, longest: float) -> NDArray[np.float32]:
    """A periodic field [n, n] with mean 0, variance 1 and wavelengths ``shortest``..``longest`` (unit of ``period``).

    Equal power in every octave of wavelength. Raises UsageError if the band holds no wave of this period, or needs
    too large a table.
    """
    n = math.ceil(period / shortest * SAMPLES_PER_WAVELENGTH)
    if n > MAX_TABLE:
        limit = period * SAMPLES_PER_WAVELENGTH / MAX_TABLE
        raise UsageError(
            f"wavelength {shortest:g} mm on a face of {period:g} mm is too fine: choose {limit:.3g} mm or more"
        )
    frequency = np.hypot(np.fft.fftfreq(n, 1.0 / n)[:, None], np.fft.rfftfreq(n, 1.0 / n))
    band = (frequency >= period / longest) & (frequency <= period / shortest)
    if not band.any():
        raise UsageError(
            f"no wave between {shortest:g} and {longest:g} mm fits a face of {period:g} mm: widen the band"
        )
    generator = np.random.default_rng(seed)
    spectrum = np.zeros(frequency.shape, dtype=np.complex128)
    waves = generator.standard_normal((2, np.count_nonzero(band)))
    spectrum[band] = (waves[0] + 1j * waves[1]) / frequency[band]
    field = np.fft.irfft2(spectrum, s=(n, n))
    return np.asarray(field / field.std(), dtype=np.float32)


def sample(field: NDArray[np.float32], period: float, u: Array, v: Array) -> Array:
    """The field [n, n] at positions u, v [m] (unit of ``period``); periodic, bilinear."""
    n = field.shape[0]
    flat = field.ravel()
    columns, wu = _cell(u, period, n)
    rows, wv = _cell(v, period, n)
    right, below = (columns + 1) % n, (rows + 1) % n * n
    rows *= n
    upper = flat[rows + columns] * (1.0 - wu) + flat[rows + right] * wu
    lower = flat[below + columns] * (1.0 - wu) + flat[below + right] * wu
    return np.asarray(upper + wv * (lower - upper))


def albedo(
    field: NDArray[np.float32], period: float, u: Array, v: Array, offset: float, contrast: float
) -> NDArray[np.float64]:
    """Grey values [m] under full light of a texture with mean ``offset`` and standard deviation ``contrast``."""
    return np.maximum(offset + contrast * sample(field, period, u, v), DARKEST)


def noise_albedo(
    seed: tuple[int, ...], wavelengths: tuple[float, float], u: Array, v: Array, offset: float, contrast: float
) -> NDArray[np.float64]:
    """``albedo`` of noise with the shortest and the longest of ``wavelengths`` that goes on for ever."""
    shortest, longest = wavelengths
    period = max(PERIOD * shortest, 4.0 * longest)
    return albedo(noise_texture(seed, period, shortest, longest), period, u, v, offset, contrast)


def _cell(position: Array, period: float, n: int) -> tuple[NDArray[np.intp], Array]:
    scaled = position * (n / period)
    cell = np.floor(scaled)
    return cell.astype(np.intp) % n, scaled - cell
