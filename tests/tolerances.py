"""How closely kernels must agree with their naive float64 twins, and why; per (arch, type of images and moments).

All kernels of the small dense matrices compute in double precision on every arch of this table, so what distinguishes
its rows is the rounding of the images and of the structure tensor.
"""

from __future__ import annotations

from dataclasses import dataclass

from leafflow_ti.runtime import Device


@dataclass(frozen=True)
class Tolerance:
    """Largest accepted differences.

    ``tensor``: of J[i, j], relative to sqrt(J[i, i] J[j, j]); ``parameters``: of flow parameters, in their standard
    errors; ``maps``: of measured quantities, in theirs; ``errors``: of standard errors, relative.
    """

    tensor: float
    parameters: float
    maps: float
    errors: float


TOLERANCES: dict[tuple[str, str], Tolerance] = {
    # A moment sums some 1e3 products: a few units of 2.2e-16 (found 8e-16). Behind it the ridge of 1e-13 on the scaled
    # tensor decides: its smallest eigenvalue is 1e-4 to 1e-5 of the largest with a brightness column, hence up to
    # 2e-8 of a standard error in the parameters (found 1.2e-8). Weights of the fits are inverses of covariances with
    # condition numbers around 50: found 5e-7, 5e-7.
    ("cpu", "f64"): Tolerance(tensor=1e-14, parameters=2e-7, maps=5e-6, errors=5e-6),
    # The images are rounded to 6e-8, products and sums once each (found 4e-7). A signal 50 times the noise makes this
    # 1e-4 of a standard error in the parameters (found 7e-5), and weights of the fits make it 7e-4, 2e-4.
    ("cpu", "f32"): Tolerance(tensor=2e-6, parameters=5e-4, maps=5e-3, errors=2e-3),
    # The same sums; drivers contract products and sums as they like.
    ("vulkan", "f32"): Tolerance(tensor=4e-6, parameters=1e-3, maps=1e-2, errors=4e-3),
}

SOLVERS = 1e-9
"""Fast solver against full Jacobi, in standard errors: both solve the same double-precision problem, on every arch.
Signal over noise is some 50, so 1e-9 of a standard error is 2e-11 of the parameters' own size."""

EXACT = 1e-12
"""Sums of exactly known polynomials in double precision: rounding of some 1e4 terms of either sign."""


def tolerance(device: Device) -> Tolerance:
    """The row for a device."""
    return TOLERANCES[device.arch, device.storage]
