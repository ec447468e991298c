"""Rotations for the synthetic scenes: right-handed, camera looking along +Z, x right, y down."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def cross_matrix(v: ArrayLike) -> Array:
    """The matrix ``[v]x`` with ``[v]x w = v × w``; shape [3, 3]."""
    x, y, z = np.asarray(v, dtype=np.float64)
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def rotation_matrix(rotation_vector: ArrayLike) -> Array:
    """Rodrigues' finite rotation about ``rotation_vector`` by its length [rad]; shape [3, 3]."""
    k = cross_matrix(rotation_vector)
    angle = float(np.linalg.norm(np.asarray(rotation_vector, dtype=np.float64)))
    # sin(a)/a and (1 - cos a)/a² through sinc: exact for tiny angles, where the quotients lose all digits.
    sine = np.sinc(angle / np.pi)
    versine = 0.5 * np.sinc(0.5 * angle / np.pi) ** 2
    return np.asarray(np.eye(3) + sine * k + versine * (k @ k))


def plane_axes(zx: float, zy: float) -> Array:
    """Orthonormal frame of the plane ``Z = ZX X + ZY Y``: columns are both in-plane axes and the normal; [3, 3].

    The smallest rotation that turns (0, 0, 1) into the normal ``(-ZX, -ZY, 1)/norm``, built from these two directions
    (Schuchert 2010, App. B, where the printed axis of rotation is wrong).
    """
    normal = np.array([-zx, -zy, 1.0]) / np.sqrt(1.0 + zx * zx + zy * zy)
    k = cross_matrix((-normal[1], normal[0], 0.0))
    return np.asarray(np.eye(3) + k + k @ k / (1.0 + normal[2]))
