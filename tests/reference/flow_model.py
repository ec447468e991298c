"""Flow parameters of a moving surface patch in closed form: a plain float64 twin of the flow equations.

Schuchert 2010, Eqs. (5.8), (5.14), (5.23), (5.25), (6.12), corrected: ``NZ/f`` in the brackets of a11 and a22, and
``∂X/∂t - N`` in the time column. Pixel (x0, y0) from the principal point, ``f`` in px, lengths in mm, time in frames.
Columns in the order (x, y, sx, sy, t); camera positions in mm.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def predict(
    x0: float,
    y0: float,
    f: float,
    Z0: float,
    ZX: float,
    ZY: float,
    N: ArrayLike,
    Omega: ArrayLike,
    A: ArrayLike,
) -> dict[str, Array]:
    """Parameters where the patch point seen at (x0, y0) has depth Z0, velocity N, rotation Omega, acceleration A.

    Returns ``nu`` [] px/mm, ``b`` [5] per mm, ``u`` [2] px/frame and ``a`` [2, 5].
    """
    N, Omega, A = (np.asarray(v, dtype=np.float64) for v in (N, Omega, A))
    ray = np.array([x0 / f, y0 / f, 1.0])
    c = 1.0 - ZX * ray[0] - ZY * ray[1]
    nu = -f / Z0
    Zt = N[2] - ZX * N[0] - ZY * N[1]

    pixel = Z0 / (f * c)
    dX = np.stack(
        [
            pixel * np.array([1.0 - ZY * ray[1], ZX * ray[1], ZX]),
            pixel * np.array([ZY * ray[0], 1.0 - ZX * ray[0], ZY]),
            np.array([c + ZX * ray[0], ZX * ray[1], ZX]) / c,
            np.array([ZY * ray[0], c + ZY * ray[1], ZY]) / c,
            Zt / c * ray,
        ]
    )
    # Z = -f/nu, hence db = f/Z² dZ for every coordinate.
    b = f / Z0**2 * dX[:, 2]

    moved = dX.copy()
    moved[4] -= N
    dU = np.cross(Omega, moved)
    dU[4] += A
    e = np.array([[1.0, 0.0, -ray[0]], [0.0, 1.0, -ray[1]]])
    a = -nu * e @ dU.T - np.outer(e @ N, b)
    a[0, 0] += nu * N[2] / f
    a[1, 1] += nu * N[2] / f
    return {"nu": np.asarray(nu), "b": b, "u": -nu * e @ N, "a": a}


def preshift(parameters: dict[str, Array], baseline: tuple[float, float], nu0: tuple[float, float]) -> dict[str, Array]:
    """The same parameters per camera step, as images shifted by ``x' = x - nu0 k`` show them.

    Derivatives along s are then taken at fixed x': ``a_k,sx' = bx a_k,sx + nu0_x a_k,x``, likewise for b and y.
    ``nu`` [2] and ``b`` [2, 5] get a first axis for steps along sx and sy.
    """

    def along_steps(m: Array) -> Array:
        out = m.copy()
        for axis in (0, 1):
            out[..., 2 + axis] = baseline[axis] * m[..., 2 + axis] + nu0[axis] * m[..., axis]
        return out

    step = np.asarray(baseline)
    return {
        "nu": step * parameters["nu"] - np.asarray(nu0),
        "b": np.outer(step, along_steps(parameters["b"])),
        "u": parameters["u"],
        "a": along_steps(parameters["a"]),
    }
