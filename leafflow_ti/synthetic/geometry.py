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


def tangent_axes(zx: ArrayLike, zy: ArrayLike) -> Array:
    """Orthonormal tangents of the planes ``Z = ZX X + ZY Y`` as columns, [..., 3, 2]: e1 above the X axis, e2 at y > 0.

    ``e1 = (1, 0, ZX)/norm`` and ``e2 = n × e1`` with the normal ``n`` of ``plane_axes``: the axes of strain rates.
    """
    zx, zy = np.broadcast_arrays(np.asarray(zx, np.float64), np.asarray(zy, np.float64))
    along = np.stack([np.ones_like(zx), np.zeros_like(zx), zx], axis=-1)
    across = np.stack([-zx * zy, 1.0 + zx * zx, zy], axis=-1)  # (-ZX, -ZY, 1) x (1, 0, ZX), but for lengths
    return np.stack([v / np.linalg.norm(v, axis=-1, keepdims=True) for v in (along, across)], axis=-1)


def in_plane(zx: float, zy: float, rates: ArrayLike) -> Array:
    """The symmetric tensor [3, 3] with components ``rates`` (11, 22, 12) along ``tangent_axes``, none along the
    normal."""
    axes = tangent_axes(zx, zy)
    r11, r22, r12 = np.asarray(rates, dtype=np.float64)
    return np.asarray(axes @ np.array([[r11, r12], [r12, r22]]) @ axes.T)


def within_outline(along: Array, across: Array, pointed: bool) -> NDArray[np.bool_]:
    """Which places of a leaf's surface [...] belong to it, in half lengths and half widths from its middle.

    ``pointed``: two parabolas that meet in tips at both ends, else an ellipse.
    """
    if pointed:
        return np.asarray(np.abs(across) <= 1.0 - along**2)
    return np.asarray(along**2 + across**2 <= 1.0)
