"""Range flow: which data vectors the range and the intensity constraints give, and how they are weighted.

A surface point with the velocity (U, V, W) [mm/frame] obeys, at the image position (x, y) from the principal point,

    (f Zx/Z) U + (f Zy/Z) V - (1 + (x Zx + y Zy)/Z) W + Zt = 0        range (Schuchert 2010, Eqs. (3.9)-(3.18))
    (f Ix/Z) U + (f Iy/Z) V - ((x Ix + y Iy)/Z) W + It = 0            intensity (4.20)-(4.25)

and the second also with a derivative of the image along x or y in the place of I. With the window's centre (x0, y0) and
``U' = U - x0/f W``, ``V' = V - y0/f W`` the offsets (Δx, Δy) take the place of (x, y): both are data vectors of the
columns (U', V', W), whose tensors add up. The unknowns are counted in px/frame, as displacements in the image at a
working distance Zr: ``f/Zr`` times U' and V', and ``r/Zr`` times W, its displacement at the distance r from the centre,
the root of the window's second moment. Columns and thresholds are then those of optical flow.

Weights. Every constraint is scaled to the noise of the intensity: with noise σ_I of the images and σ_Z of the range
[mm], the range constraint gets the factor ``σ_I / (β σ_Z)``, that of a derivative of the image 1 over the norm of its
filter. m constraints on the intensity share one image's noise and count as one: each gets another ``1 / √m``. β weights
intensity against range beyond what their noise says. A range that was itself smoothed over windows (our own depth) has
correlated noise: σ_Z is then that of the white noise which, smoothed likewise, leaves the standard error that the range
has. The error bars take the noise of both for white; on textures whose derivatives are not, those of ``grad`` and
``intgrad`` are up to 1.5 times too small.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.models import BRIGHTNESS, BRIGHTNESS_TERMS, ONE, Column, ColumnSet, Derived, Term, monomial
from leafflow_ti.sampling import AxisSampling, Sampling, noise_gain

CONSTRAINTS: dict[str, tuple[str, ...]] = {
    "int": ("i",),
    "grad": ("gx", "gy"),
    "intgrad": ("i", "gx", "gy"),
    "taylor": ("i",),
}
"""Images whose constancy is used: the intensity, its derivatives. ``taylor`` lets the intensity change as (4.27)."""

STACK = ("i", "z", "gx", "gy")
"""Images of one frame: intensity, range, derivatives of the intensity along x and y."""

FINEST_RANGE = 1e-5
"""Least noise of the range, relative to its distance: what is finer weighs no more than this."""


def images(constraint: str) -> tuple[str, ...]:
    """The images of one frame that a constraint needs; intensity and range always."""
    return tuple(name for name in STACK if name in ("i", "z") or name in CONSTRAINTS[constraint])


def gradient_kernel(sampling: Sampling, axis: str) -> NDArray[np.float64]:
    """Filter [y, x] that makes the derivative image along ``axis``."""
    return np.outer(sampling.y.kernel(axis == "y"), sampling.x.kernel(axis == "x"))


def columns(constraint: str, sampling: Sampling, brightness_terms: str = "none", range_noise: float = 1.0) -> ColumnSet:
    """Columns (U', V', W), brightness where the constraint has it, and the derivatives in time.

    ``range_noise``: noise variance of a sample of the scaled range relative to that of the intensity.
    """
    stack, used = images(constraint), CONSTRAINTS[constraint]
    derived: dict[str, Derived] = {}

    def channel(image: str, axis: str, factor: int | None, scale: float) -> str:
        name = axis if image == used[0] else f"{image}.{axis}"
        prefilter = image[1] if image.startswith("g") else None
        gain = scale * (_gain(sampling, axis, prefilter) if axis != "1" else 0.0)
        derived[name] = Derived(stack.index(image), axis, factor, gain)
        return name

    def vector(image: str, number: int) -> list[list[Term]]:
        """Terms of U', V', W and of the time-like column."""
        norm = 1.0 if image == "z" else len(used) ** -0.5
        if image.startswith("g"):
            norm *= float(np.sum(gradient_kernel(sampling, image[1]) ** 2)) ** -0.5
        noise = range_noise if image == "z" else 1.0
        own = 0 if image == "z" else 3
        x, y, t = (channel(image, a, o, noise) for a, o in (("x", own), ("y", own), ("t", 2 if own == 0 else None)))
        depth = [Term(channel("z", "1", 1, 0.0), ONE, -1.0, number)] if image == "z" else []
        across = [Term(c, monomial(a), -norm / window_radius(sampling), number) for c, a in ((x, "x"), (y, "y"))]
        return [
            [Term(x, ONE, norm, number)],
            [Term(y, ONE, norm, number)],
            [*depth, *across],
            [Term(t, ONE, norm, number)],
        ]

    vectors = [vector(image, k) for k, image in enumerate((*used, "z"))]
    merged = [tuple(term for v in vectors for term in v[k]) for k in range(4)]
    # The range's own term gives the column of W its name: the noise of its sums is the larger one.
    merged[2] = tuple(sorted(merged[2], key=lambda term: term.exponents != ONE))
    light: list[Column] = []
    if constraint == "taylor":
        channel("i", "i", None, 1.0)
        wanted = (*BRIGHTNESS["spatial"], *BRIGHTNESS_TERMS[brightness_terms])
        sampled = sampling.sampled
        light = [Column.of("i", o, sampled) for o in wanted if o == "1" or all(a in sampled for a in o)]
    return ColumnSet((*map(Column, merged[:3]), *light, Column(merged[3])), 1, derived)


def window_radius(sampling: Sampling) -> float:
    """Distance r from the window's centre [px] at which W is counted."""
    return float(np.sqrt(0.5 * (sampling.x.moment(2) + sampling.y.moment(2))))


def _gain(sampling: Sampling, axis: str, prefilter: str | None) -> float:
    """Noise gain of a channel, of a derivative image relative to that image's own noise."""
    if prefilter is None:
        return noise_gain(sampling, axis)
    gain = float(np.sum(sampling.t.kernel(axis == "t") ** 2))
    for name, along in (("x", sampling.x), ("y", sampling.y)):
        gain *= float(np.sum(np.convolve(along.kernel(axis == name), along.kernel(prefilter == name)) ** 2))
    return gain


def factors(
    depth: NDArray[Any], noise: NDArray[Any], working_mm: float, radius_px: float, image_noise: float, beta: float
) -> NDArray[Any]:
    """Planes [4, y, x] for the channels: of Zx and Zy, of the constant, of Zt, of Ix and Iy; 0 without range.

    ``depth`` and its white ``noise`` [mm] (see the module's docstring), NaN where there is none; ``radius_px``: that of
    ``window_radius``.
    """
    seen = np.isfinite(depth) & np.isfinite(noise) & (depth > 0)
    ratio = working_mm / np.where(seen, depth, np.inf)
    weight = image_noise / (beta * np.where(seen, np.maximum(noise, FINEST_RANGE * depth), np.inf))
    return np.stack([weight * ratio, weight * (working_mm / radius_px), weight, ratio])


def smoothed_samples(x: AxisSampling, y: AxisSampling) -> float:
    """White samples that a window mean has the weight of: ``1 / Σ w²``."""
    return float(1.0 / np.prod([np.sum(np.array(axis.weights) ** 2) for axis in (x, y)]))
