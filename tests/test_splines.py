"""Splines of the refinement: pieces and filter, what they do to noise, and how far they misplace a wave."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.interpolate import BSpline
from scipy.ndimage import gaussian_filter, spline_filter1d

from leafflow_ti.splines import LEAST_TAP, PREFILTER_SIGMA, filter_radius, filter_taps, spline, spline_pieces, support
from leafflow_ti.stages.refine_tables import noise_correlation

DEGREES = (5, 7)


@pytest.mark.parametrize("degree", DEGREES)
def test_pieces_are_those_of_the_cardinal_spline(degree: int) -> None:
    reach = support(degree)
    basis = BSpline.basis_element(np.arange(-reach, reach + 1.0), extrapolate=False)
    u = np.linspace(0.0, 1.0, 21)[:-1]
    powers = u[:, None] ** np.arange(degree + 1)
    for derivative in range(3):
        wanted = basis.derivative(derivative) if derivative else basis
        for neighbour in range(degree + 1):
            at = u + reach - 1 - neighbour
            found = powers @ spline_pieces(degree)[derivative, neighbour]
            np.testing.assert_allclose(found, np.nan_to_num(wanted(at)), atol=1e-13)
    at = np.linspace(-5.0, 5.0, 101)
    np.testing.assert_allclose(spline(at, degree), np.nan_to_num(basis(at)), atol=1e-13)


@pytest.mark.parametrize("degree", DEGREES)
def test_filter_is_a_gaussian_and_the_splines_own(degree: int) -> None:
    """Its coefficients, at the pixels, are the smoothed image; what is cut off are taps below 1e-7 of the largest."""
    taps = filter_taps(degree)
    assert len(taps) == 2 * filter_radius(degree) + 1
    np.testing.assert_array_equal(taps, taps[::-1])
    assert taps.sum() == pytest.approx(1, abs=1e-15)
    assert np.abs(taps).min() >= LEAST_TAP * taps.max()
    row = np.random.default_rng(0).uniform(0, 255, 200)
    smooth = gaussian_filter(row, PREFILTER_SIGMA, truncate=8, mode="mirror")
    there = np.convolve(np.convolve(row, taps, "same"), spline(np.arange(-3.0, 4.0), degree), "same")
    # Twice the first tap left out, .54 of the last, and the geometric tail behind it; far from the ends.
    inner = slice(60, -60)
    np.testing.assert_allclose(there[inner], smooth[inner], atol=255 * 4e-7)
    if degree == 5:
        wanted = spline_filter1d(smooth, degree, mode="mirror")
        np.testing.assert_allclose(np.convolve(row, taps, "same")[inner], wanted[inner], atol=255 * 4e-7)


def interpolated(row: np.ndarray, at: np.ndarray, degree: int) -> np.ndarray:
    """The spline of a smoothed row [n] at positions [m] px, far from its ends."""
    reach = support(degree)
    coefficients = np.convolve(row, filter_taps(degree), "same")
    left = np.floor(at).astype(int)
    neighbours = coefficients[left[:, None] + np.arange(1 - reach, reach + 1)]
    powers = (at - left)[:, None] ** np.arange(degree + 1)
    return np.asarray(np.einsum("ij,ij->i", neighbours, powers @ spline_pieces(degree)[0].T))


@pytest.mark.parametrize("degree", DEGREES)
@pytest.mark.parametrize("wavelength", [4, 6, 8, 16])
def test_a_wave_is_misplaced_as_theory_says(wavelength: int, degree: int) -> None:
    """Beside a wave of frequency ω an interpolation shows its nearest alias, at 2π - ω, weaker by the power
    (ω/(2π - ω))^(degree + 1): where the wave is steep that moves it by up to this share over ω, in px. Aliases further
    off add 5 % at most; looking at slopes down to .99 of the steepest adds 14 % of the same share, of the wave's own
    loss."""
    omega = 2 * np.pi / wavelength
    at = np.arange(100.0, 100.0 + wavelength, 0.002)
    n, offsets = np.arange(220.0), np.arange(-filter_radius(degree), filter_radius(degree) + 1.0)
    # Of what the samples at the pixels keep.
    wave = np.cos(omega * offsets)
    amplitude = filter_taps(degree) @ wave * (spline(offsets, degree) @ wave)
    misplaced = []
    for shift in np.linspace(0.0, 1.0, 41):
        slope = -amplitude * omega * np.sin(omega * (at - shift))
        steep = np.abs(slope) > 0.99 * amplitude * omega
        error = interpolated(np.cos(omega * (n - shift)), at, degree) - amplitude * np.cos(omega * (at - shift))
        misplaced.append(np.abs(error / slope)[steep].max())
    theory = (omega / (2 * np.pi - omega)) ** (degree + 1) / omega
    rounding = 2e-7  # of taps that are left out
    assert 0.9 * theory - rounding < max(misplaced) < 1.3 * theory + rounding


@pytest.mark.parametrize("degree", DEGREES)
@pytest.mark.parametrize("thin", [1, 2, 3])
def test_noise_is_correlated_as_stated(thin: int, degree: int) -> None:
    """White noise read between pixels: a quarter of a million values know a correlation to .4 % or better."""
    noise = np.random.default_rng(thin).normal(size=260_000)
    at = np.arange(40, noise.size - 80) + np.random.default_rng(0).uniform(size=noise.size - 120)
    values = interpolated(noise, at, degree)
    stated = noise_correlation(thin, degree)
    assert stated[0] == 1
    for step in range(len(stated) + 1):
        apart = interpolated(noise, at + step * thin, degree)
        wanted = stated[step] if step < len(stated) else 0.0
        assert np.mean(values * apart) / np.mean(values**2) == pytest.approx(wanted, abs=0.01)
