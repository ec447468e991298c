"""What a window of random texture is expected to hold: the structure tensor, before any image is taken.

The texture is stationary: sums over a window become expectations. Of two channels a, b, filters with the transfer
functions H over the five axes, the mean product is ``∫ S(ω) H_a(ω) H_b(ω)* dω`` (S the spectrum of the image); along
camera and time axes a wave ω that moves by v px per sample has the frequency ``-v·ω``. The columns of the data vector
along cameras and time follow from the others by the exact flow; the noise of the images adds its own.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.models import AXES, Column, ColumnSet, TensorLayout
from leafflow_ti.sampling import AxisSampling, Sampling, column_noise, noise_gain, white_smoothness

Array = NDArray[np.float64]

RINGS, SPOKES = 48, 24
"""Waves that stand for a spectrum: wavelengths (logarithmic) and directions in half a circle."""
NYQUIST = np.pi
"""Highest frequency of an image [rad/px]; what is finer is not in it, whatever the surface has."""


@dataclass(frozen=True, eq=False)
class Spectrum:
    """The texture of an image as waves: ``omega`` [n, 2] rad/px and the ``power`` [n] of each, in grey values²."""

    omega: Array
    power: Array

    @classmethod
    def of(cls, wavelengths_mm: tuple[float, float], exponent: float, contrast: float, mm_per_px: Array) -> Spectrum:
        """Isotropic noise on a surface, with power per area of the frequency plane as ``frequency^-exponent``.

        ``contrast``: standard deviation on the surface [grey values]; ``mm_per_px`` [2, 2]: how surface coordinates
        change along x and y of the image. The sensor's square pixels average it.
        """
        shortest, longest = wavelengths_mm
        edges = np.geomspace(2 * np.pi / longest, 2 * np.pi / shortest, RINGS + 1)
        radius = np.sqrt(edges[1:] * edges[:-1])
        ring = radius ** (1 - exponent) * np.diff(edges)
        angle = np.pi * (np.arange(SPOKES) + 0.5) / SPOKES
        on_surface = radius[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        omega = on_surface.reshape(-1, 2) @ mm_per_px
        power = np.repeat(contrast**2 * ring / (ring.sum() * SPOKES), SPOKES)
        power = np.where(np.abs(omega).max(axis=1) < NYQUIST, power, 0.0)
        return cls(omega, power * np.prod(np.sinc(omega / (2 * np.pi)), axis=1) ** 2)

    @property
    def contrast(self) -> float:
        """Standard deviation of the image's grey values."""
        return float(np.sqrt(self.power.sum()))

    def passed(self, response: NDArray[np.complex128]) -> Spectrum:
        """What is left behind a filter with this transfer function [n]."""
        return Spectrum(self.omega, self.power * np.abs(response) ** 2)


def transfer(axis: AxisSampling, differentiate: bool, omega: Array) -> NDArray[np.complex128]:
    """What a filter along one axis makes of waves of frequency ``omega`` [n] rad per sample."""
    kernel = axis.kernel(differentiate)
    offset = np.arange(len(kernel)) - len(kernel) // 2
    return np.asarray(np.exp(1j * np.outer(omega, offset)) @ kernel)


@dataclass(frozen=True, eq=False)
class ExpectedTexture:
    """What windows of a texture hold: ``gradients`` [n_flow, n_flow], the structure tensor without noise of the columns
    that are not time-like; ``noise`` [N], what the images' noise adds to its diagonal; ``energies`` of the gradient,
    of the gradient smoothed once more, of the image."""

    gradients: Array
    noise: Array
    energies: tuple[float, float, float]

    @classmethod
    def of(
        cls, spectrum: Spectrum, sampling: Sampling, columns: ColumnSet,
        shift: Mapping[str, tuple[float, float]], noise: float, mean: float,
    ) -> ExpectedTexture:  # fmt: skip
        """``shift``: px per sample (x, y) of the texture along camera and time axes; ``noise``: standard deviation in
        the images, ``mean``: their grey value."""
        for axis, step in shift.items():
            spectrum = spectrum.passed(transfer(sampling.axis(axis), False, spectrum.omega @ np.array(step)))
        flow = columns.columns[: columns.n_flow]
        products = _products(spectrum, sampling, tuple(dict.fromkeys(("x", "y", *(c.channel for c in flow)))))
        if ("i", "i") in products:
            products["i", "i"] += mean**2

        def entry(a: Column, b: Column) -> float:
            return sum(
                p.factor * q.factor * products[p.channel, q.channel]
                * sampling.moment(tuple(m + n for m, n in zip(p.exponents, q.exponents, strict=True)))
                for p, q in product(a.terms, b.terms)
            )  # fmt: skip

        gains = noise**2 * (noise_gain(sampling, "x") + noise_gain(sampling, "y"))
        smooth = (transfer(axis, False, spectrum.omega[:, k]) for k, axis in enumerate((sampling.x, sampling.y)))
        again = _products(spectrum.passed(next(smooth) * next(smooth)), sampling, ("x", "y"))
        return cls(
            np.array([[entry(a, b) for b in flow] for a in flow]),
            noise**2 * column_noise(sampling, columns),
            (
                products["x", "x"] + products["y", "y"] + gains,
                again["x", "x"] + again["y", "y"] + gains * white_smoothness(sampling),
                mean**2 + spectrum.contrast**2 + noise**2,
            ),
        )

    def tensor(self, parameters: Array) -> Array:
        """J [N, N] where the flow is that of the model, ``parameters`` [n_flow, n_time_like]: the columns along cameras
        and time are made of the others."""
        mixed = -self.gradients @ parameters
        J = np.block([[self.gradients, mixed], [mixed.T, parameters.T @ self.gradients @ parameters]])
        return np.asarray(J + np.diag(self.noise))

    def planes(self, layout: TensorLayout, parameters: Array) -> Array:
        """As the tensor stage hands it over: distinct entries, window mass, energies."""
        J, entries = self.tensor(parameters), np.zeros(len(layout.entries))
        rows, cols = np.tril_indices(len(J))
        entries[list(layout.lower)] = J[rows, cols]
        return np.concatenate([entries, [1.0], self.energies])


def _products(spectrum: Spectrum, sampling: Sampling, channels: tuple[str, ...]) -> dict[tuple[str, str], float]:
    """Mean products of the channels x, y, i."""
    responses = {
        channel: transfer(sampling.x, channel == "x", spectrum.omega[:, 0])
        * transfer(sampling.y, channel == "y", spectrum.omega[:, 1])
        for channel in channels
    }
    return {
        (a, b): float(np.sum(spectrum.power * (responses[a] * responses[b].conj()).real))
        for a, b in product(channels, channels)
    }


def flow_parameters_of(columns: ColumnSet, fields: Mapping[str, Mapping[str, tuple[float, Array]]]) -> Array:
    """Parameters [n_flow, n_time_like] of columns; ``fields``: solution -> channels and, by channel, the value at the
    centre and the derivatives [5] along ``AXES``."""
    found = np.zeros((columns.n_flow, columns.n_time_like))
    for k, solution in enumerate(columns.solutions):
        for channel, (value, derivatives) in fields[solution].items():
            for i, column in enumerate(columns.columns[: columns.n_flow]):
                if column.channel == channel:
                    offset = column.offset
                    found[i, k] = value if offset == "1" else derivatives[AXES.index(offset)]
    return found
