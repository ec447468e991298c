"""Rows of the motion fit at one pixel: what the flow's parameters say of N, Ω, A and ε, and the row of range flow."""

import functools

import numpy as np


def surface(x0, y0, f, nu, b1=0.0, b2=0.0):
    """Z0, ZX, ZY, c of Eq. (6.13), (6.14); x0, y0 from the principal point."""
    Z0 = -f / nu
    p, q = b1 * Z0, b2 * Z0
    c = 1 / (1 + p * x0 / f + q * y0 / f)
    return Z0, c * p, c * q, c


def motion_rows(x0, y0, f, geometry, offsets, q, shift, baseline, curved=None, centroid=(0.0, 0.0)):
    """Design [rows, 10] by (N, Ω, A, ε) of the motion rows, linearised about the motion ``q`` for Ω × N (5.18).

    Rows run over the directions, then the offsets. The s-offsets are per camera step at the preshifted pixel.
    ``curved`` [3, 3]: projections of x², xy, y² (columns) on 1, x, y over the window, by which these rows see the
    flow's second-order part. ``centroid`` (x, y): of what the window sees, from the pixel; derivatives along s and t
    are those there.
    """
    if np.any(centroid):
        x, y, plane, there, P = moved(x0, y0, f, geometry, q, centroid)
        here = motion_rows(x0, y0, f, geometry, offsets, q, shift, baseline, curved)
        away = about_point(motion_rows(x, y, f, plane, offsets, there, shift, baseline), P)
        far = np.array([o in ("sx", "sy", "t") for _ in (0, 1) for o in offsets])
        return np.where(far[:, None], away, here)
    nu, b1, b2 = geometry
    Z0, ZX, ZY, c = surface(x0, y0, f, nu, b1, b2)
    N = np.zeros(3)
    N[: min(3, len(q))] = q[:3]
    Zt = N[2] - ZX * N[0] - ZY * N[1]
    e = np.array([[1, 0, -x0 / f], [0, 1, -y0 / f]])
    delta = {
        "x": Z0 / (f * c) * np.array([1 - ZY * y0 / f, ZX * y0 / f, ZX]),
        "y": Z0 / (f * c) * np.array([ZY * x0 / f, 1 - ZX * x0 / f, ZY]),
        "sx": np.array([c + ZX * x0 / f, ZX * y0 / f, ZX]) / c,
        "sy": np.array([ZY * x0 / f, c + ZY * y0 / f, ZY]) / c,
        "t": Zt / (f * c) * np.array([x0, y0, f]) - N,
    }
    b = {
        "x": ZX / (Z0 * c),
        "y": ZY / (Z0 * c),
        "sx": f * ZX / (Z0**2 * c),
        "sy": f * ZY / (Z0**2 * c),
        "t": f * Zt / (Z0**2 * c),
    }

    def row(k, o):
        r = np.zeros(10)
        if o == "1":
            r[:3] = -nu * e[k]
            return r
        r[:3] = -b[o] * e[k]
        if (o, k) in (("x", 0), ("y", 1)):
            r[2] += nu / f
        r[3:6] = -nu * cross(delta[o], e[k])
        r[9] = -nu * e[k] @ delta[o]
        if o == "t":
            r[6:9] = -nu * e[k]
        return r

    def projected(k, o):
        # Along s nothing is bent: what is seen there is the derivative of the flow alone.
        return (curved["1xy".index(o)] * (0.5, 1.0, 0.5)) @ second_derivatives(x0, y0, f, (Z0, ZX, ZY))[k]

    def measured(k, o):
        if o == "sx":
            return baseline[0] * row(k, "sx") + shift[0] * row(k, "x")
        if o == "sy":
            return baseline[1] * row(k, "sy") + shift[1] * row(k, "y")
        return row(k, o) if curved is None or o == "t" else row(k, o) + projected(k, o)

    return np.array([measured(k, o) for k in (0, 1) for o in offsets])


@functools.cache  # the rows that one pixel needs ask for the same ones again and again
def second_derivatives(x0, y0, f, plane):
    """Coefficients [2, 3, 10] of (N, Ω, A, ε) of ∂²/∂x², ∂²/∂x∂y, ∂²/∂y² of the flow u, v on the plane (Z0, ZX, ZY) at
    (x0, y0), by exact differences.

    The flow of a rigidly moving plane is quadratic in x and y, so second differences of any width are exact.
    """
    Z0, ZX, ZY = plane
    X0 = Z0 * np.array([x0 / f, y0 / f, 1.0])
    h = 0.05 * f

    def flow(i, j):
        """Of each component of the motion alone [2, 10], i and j steps h away along x and y."""
        ray = np.array([(x0 + i * h) / f, (y0 + j * h) / f, 1.0])
        X = (Z0 - ZX * X0[0] - ZY * X0[1]) / (1 - ZX * ray[0] - ZY * ray[1]) * ray
        seen = np.zeros((2, 10))
        for k, along in enumerate(np.array([[1.0, 0.0, -ray[0]], [0.0, 1.0, -ray[1]]])):
            seen[k, :3], seen[k, 3:6], seen[k, 9] = along, cross(X - X0, along), along @ (X - X0)
        return f * seen / X[2]

    at = {(i, j): flow(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1)}
    along_x = at[1, 0] - 2 * at[0, 0] + at[-1, 0]
    along_y = at[0, 1] - 2 * at[0, 0] + at[0, -1]
    mixed = (at[1, 1] - at[1, -1] - at[-1, 1] + at[-1, -1]) / 4
    return np.stack([along_x, mixed, along_y], axis=1) / h**2


def cross(u, v):
    """The cross product; many times as fast as NumPy's for one pair."""
    return np.array([u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]])


def moved(x0, y0, f, geometry, q, by):
    """Pixel, geometry and motion where the patch is seen ``by`` (x, y) px further; P from its point to there."""
    nu, b1, b2 = geometry
    x, y = x0 + by[0], y0 + by[1]
    there = (nu + b1 * by[0] + b2 * by[1], b1, b2)
    P = -f / there[0] * np.array([x / f, y / f, 1.0]) + f / nu * np.array([x0 / f, y0 / f, 1.0])
    motion = np.array(q, float)
    motion[:3] += np.cross(q[3:6], P) + q[9] * P
    return x, y, there, motion, P


def about_point(rows, P):
    """Design [rows, 10] by the motion of the patch from that by the motion of its part at P."""
    rows = rows.copy()
    rows[:, 3:6] += np.cross(P, rows[:, :3])
    rows[:, 9] += rows[:, :3] @ P
    return rows


def range_row(x0, y0, f, geometry, centroid=(0.0, 0.0)):
    """Design [10] of the range constraint for b_t (5.23), which is that at the centroid of what is seen."""
    if np.any(centroid):
        x, y, there, _, P = moved(x0, y0, f, geometry, np.zeros(10), centroid)
        row = about_point(range_row(x, y, f, there)[None], P)[0]
        row[9] = 0.0  # growth moves points within the plane
        return row
    Z0, ZX, ZY, c = surface(x0, y0, f, *geometry)
    r = np.zeros(10)
    r[:3] = f / (Z0**2 * c) * np.array([-ZX, -ZY, 1.0])
    return r
