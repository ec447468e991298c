"""Quintic splines: pieces and filter against SciPy, what they do to noise, and how far they misplace a wave."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import BSpline
from scipy.ndimage import gaussian_filter, map_coordinates, spline_filter1d

from leafflow_ti.splines import (
    DEGREE,
    FILTER_RADIUS,
    LEAST_TAP,
    PREFILTER_SIGMA,
    SUPPORT,
    filter_taps,
    spline,
    spline_pieces,
)
from leafflow_ti.stages.refine_tables import _noise_correlation


def test_pieces_are_those_of_the_cardinal_spline() -> None:
    basis = BSpline.basis_element(np.arange(-SUPPORT, SUPPORT + 1.0), extrapolate=False)
    u = np.linspace(0.0, 1.0, 21)[:-1]
    powers = u[:, None] ** np.arange(DEGREE + 1)
    for derivative in range(3):
        wanted = basis.derivative(derivative) if derivative else basis
        for neighbour in range(DEGREE + 1):
            at = u - (neighbour - 2)
            found = powers @ spline_pieces()[derivative, neighbour]
            np.testing.assert_allclose(found, np.nan_to_num(wanted(at)), atol=1e-13)
    at = np.linspace(-4.0, 4.0, 81)
    np.testing.assert_allclose(spline(at), np.nan_to_num(basis(at)), atol=1e-13)


def test_filter_is_a_gaussian_and_the_splines_own() -> None:
    """Against SciPy's recursive filter; what is cut off are taps below 1e-7 of the largest."""
    taps = filter_taps()
    assert len(taps) == 2 * FILTER_RADIUS + 1
    np.testing.assert_allclose(taps, taps[::-1], rtol=0, atol=1e-16)
    assert taps.sum() == pytest.approx(1, abs=1e-15)
    ends = np.abs(taps[[0, -1]])
    assert (ends >= LEAST_TAP * taps.max() / 2).all()
    row = np.random.default_rng(0).uniform(0, 255, 200)
    wanted = spline_filter1d(gaussian_filter(row, PREFILTER_SIGMA, truncate=8, mode="mirror"), DEGREE, mode="mirror")
    # Twice the first tap left out, and the geometric tail behind it; far from the ends.
    inner = slice(60, -60)
    np.testing.assert_allclose(np.convolve(row, taps, "same")[inner], wanted[inner], atol=5 * 255 * 1e-7)


def test_spline_of_the_coefficients_is_the_smoothed_image() -> None:
    row = np.random.default_rng(1).uniform(0, 255, 200)
    coefficients = np.convolve(row, filter_taps(), "same")
    at = np.arange(60, 140)
    found = map_coordinates(coefficients, at[None], order=DEGREE, prefilter=False, mode="mirror")
    np.testing.assert_allclose(found, gaussian_filter(row, PREFILTER_SIGMA, truncate=8)[at], atol=5 * 255 * 1e-7)


def interpolated(row: np.ndarray, at: np.ndarray) -> np.ndarray:
    """The spline of a smoothed row [n] at positions [m] px, far from its ends."""
    coefficients = np.convolve(row, filter_taps(), "same")
    left = np.floor(at).astype(int)
    neighbours = coefficients[left[:, None] + np.arange(-2, 4)]
    powers = (at - left)[:, None] ** np.arange(DEGREE + 1)
    return np.asarray(np.einsum("ij,ij->i", neighbours, powers @ spline_pieces()[0].T))


@pytest.mark.parametrize("wavelength", [4, 6, 8, 16])
def test_a_wave_is_misplaced_as_theory_says(wavelength: int) -> None:
    """Beside a wave of frequency ω an interpolation shows its nearest alias, at 2π - ω, weaker by (ω/(2π - ω))^6: where
    the wave is steep that moves it by up to this share over ω, in px. Aliases further off add 5 % at most; looking at
    slopes down to .99 of the steepest adds 14 % of the same share, of the wave's own loss."""
    omega = 2 * np.pi / wavelength
    at = np.arange(100.0, 100.0 + wavelength, 0.002)
    n, offsets = np.arange(220.0), np.arange(-FILTER_RADIUS, FILTER_RADIUS + 1.0)
    # Of what the samples at the pixels keep.
    amplitude = filter_taps() @ np.cos(omega * offsets) * (spline(offsets) @ np.cos(omega * offsets))
    misplaced = []
    for shift in np.linspace(0.0, 1.0, 41):
        slope = -amplitude * omega * np.sin(omega * (at - shift))
        steep = np.abs(slope) > 0.99 * amplitude * omega
        error = interpolated(np.cos(omega * (n - shift)), at) - amplitude * np.cos(omega * (at - shift))
        misplaced.append(np.abs(error / slope)[steep].max())
    theory = (omega / (2 * np.pi - omega)) ** 6 / omega
    rounding = 1e-7  # of taps that are left out
    assert 0.9 * theory - rounding < max(misplaced) < 1.3 * theory + rounding


@pytest.mark.parametrize("thin", [1, 2, 3])
def test_noise_is_correlated_as_stated(thin: int) -> None:
    """White noise read between pixels, a quarter of a million values: covariances to .4 % of the variance."""
    noise = np.random.default_rng(thin).normal(size=260_000)
    at = np.arange(40, noise.size - 40) + np.random.default_rng(0).uniform(size=noise.size - 80)
    values = interpolated(noise, at)
    stated = _noise_correlation(thin)
    assert stated[0] == 1
    for step in range(len(stated) + 1):
        apart = interpolated(noise, np.minimum(at + step * thin, noise.size - 30))
        wanted = stated[step] if step < len(stated) else 0.0
        assert np.mean(values * apart) / np.mean(values**2) == pytest.approx(wanted, abs=0.01)
