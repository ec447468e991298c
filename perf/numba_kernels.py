"""The three stages in numba, as well as numba lets them be written (see ``numba_twin``).

float32 storage, the small matrices in float64, all threads. Filters are fused strip by strip so that nothing but the
raw frames and the finished maps goes through memory; windows hold several rows per load; the null space is a Cholesky
factor, block inverse iteration from the least-squares solution and a small Jacobi, over 32 pixels at once. The sizes
of ``affine-4d`` with 9 cameras and frames are written out: 5 taps, 5 samples.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit, prange
from numpy.typing import NDArray

Array = NDArray[Any]
STRIP = 16
"""Rows whose filtered images one thread holds."""
WIDE = 128
"""Columns whose window sums one thread holds."""
TAPS = 8
"""Taps of a window that are worked on together: each load and store of a sum serves so many multiply-adds."""
LANES = 32
"""Pixels whose matrices are worked on together: the innermost loop."""
BLOCK = 4
ITERATIONS = 2
SWEEPS = 5
jit = njit(parallel=True, fastmath=True, cache=True, boundscheck=False)
inline = njit(fastmath=True, cache=True, boundscheck=False)


@inline
def _taps5(out: Array, r0: Array, r1: Array, r2: Array, r3: Array, r4: Array, w: Array) -> None:
    """``out = Σ w_k r_k``, elementwise."""
    w0, w1, w2, w3, w4 = w[0], w[1], w[2], w[3], w[4]
    for x in range(out.shape[0]):
        out[x] = w0 * r0[x] + w1 * r1[x] + w2 * r2[x] + w3 * r3[x] + w4 * r4[x]


@inline
def _along_x(out: Array, row: Array, w: Array) -> None:
    w0, w1, w2, w3, w4 = w[0], w[1], w[2], w[3], w[4]
    for x in range(out.shape[0]):
        out[x] = w0 * row[x] + w1 * row[x + 1] + w2 * row[x + 2] + w3 * row[x + 3] + w4 * row[x + 4]


@inline
def _products(out: Array, a: Array, b: Array, weights: Array, first: int, n_powers: int) -> None:
    """Maps ``first``.. of one pair of channels [5, width]: products summed over cameras for each power of the offset.

    ``out`` [maps, width]; ``weights`` [3, 5].
    """
    u, v, w = weights[0], weights[1], weights[2]
    u0, u1, u2, u3, u4 = u[0], u[1], u[2], u[3], u[4]
    v0, v1, v2, v3, v4 = v[0], v[1], v[2], v[3], v[4]
    w0, w1, w2, w3, w4 = w[0], w[1], w[2], w[3], w[4]
    out0, out1, out2 = out[first], out[first + min(1, n_powers - 1)], out[first + n_powers - 1]
    for x in range(out.shape[1]):
        p0, p1, p2 = a[0, x] * b[0, x], a[1, x] * b[1, x], a[2, x] * b[2, x]
        p3, p4 = a[3, x] * b[3, x], a[4, x] * b[4, x]
        if n_powers > 2:
            out2[x] = w0 * p0 + w1 * p1 + w2 * p2 + w3 * p3 + w4 * p4
        if n_powers > 1:
            out1[x] = v0 * p0 + v1 * p1 + v2 * p2 + v3 * p3 + v4 * p4
        out0[x] = u0 * p0 + u1 * p1 + u2 * p2 + u3 * p3 + u4 * p4


@jit
def frame_maps(raw: Array, d: Array, b: Array, weights: Array, pairs: Array, out: Array) -> None:
    """Products of the channels Ix, Iy, Is, It of the middle one of 5 frames, summed over 5 cameras.

    ``raw`` [5, 9, rows + 4, cols + 4]; ``d``, ``b`` [5]: derivative and smoothing; ``weights`` [3, 5]: window over the
    cameras times the powers of their offsets; ``pairs`` [n, 4]: two channels, first map, number of powers; ``out``
    [maps, rows, cols].
    """
    rows, cols = out.shape[1], out.shape[2]
    wide = cols + 4
    for strip in prange((rows + STRIP - 1) // STRIP):
        y0 = strip * STRIP
        high = min(STRIP, rows - y0)
        over_t = np.empty((2, 9, wide), np.float32)
        over_s = np.empty((3, 5, STRIP + 4, wide), np.float32)
        over_y = np.empty((4, 5, wide), np.float32)
        channels = np.empty((4, 5, cols), np.float32)
        for y in range(high + 4):
            for c in range(9):
                r = raw[:, c, y0 + y]
                _taps5(over_t[0, c], r[0], r[1], r[2], r[3], r[4], b)
                _taps5(over_t[1, c], r[0], r[1], r[2], r[3], r[4], d)
            for s in range(5):
                i, t = over_t[0], over_t[1]
                _taps5(over_s[0, s, y], i[s], i[s + 1], i[s + 2], i[s + 3], i[s + 4], b)
                _taps5(over_s[1, s, y], i[s], i[s + 1], i[s + 2], i[s + 3], i[s + 4], d)
                _taps5(over_s[2, s, y], t[s], t[s + 1], t[s + 2], t[s + 3], t[s + 4], b)
        for y in range(high):
            for s in range(5):
                for k in range(4):
                    source = over_s[max(0, k - 1), s]
                    kernel = d if k == 1 else b
                    _taps5(over_y[k, s], source[y], source[y + 1], source[y + 2], source[y + 3], source[y + 4], kernel)
                    _along_x(channels[k, s], over_y[k, s], d if k == 0 else b)
            for pair in range(pairs.shape[0]):
                one, two, first, powers = pairs[pair]
                _products(out[:, y0 + y], channels[one], channels[two], weights, first, powers)


@inline
def _add_taps(sums: Array, rows: Array, first: int, w: Array, tap: int) -> None:
    """``sums += Σ_k w[tap + k] rows[first + k]`` for 8 rows; rows of WIDE numbers, one behind the other."""
    w0, w1, w2, w3 = w[tap], w[tap + 1], w[tap + 2], w[tap + 3]
    w4, w5, w6, w7 = w[tap + 4], w[tap + 5], w[tap + 6], w[tap + 7]
    r = rows[first * WIDE :]
    for x in range(WIDE):
        sums[x] += (
            w0 * r[x] + w1 * r[x + WIDE] + w2 * r[x + 2 * WIDE] + w3 * r[x + 3 * WIDE]
            + w4 * r[x + 4 * WIDE] + w5 * r[x + 5 * WIDE] + w6 * r[x + 6 * WIDE] + w7 * r[x + 7 * WIDE]
        )  # fmt: skip


@inline
def _add_taps_to_four(sums: Array, rows: Array, first: int, w: Array, tap: int) -> None:
    """The same for 4 sums that begin one row after the other: 11 loads serve 32 products."""
    w0, w1, w2, w3 = w[tap], w[tap + 1], w[tap + 2], w[tap + 3]
    w4, w5, w6, w7 = w[tap + 4], w[tap + 5], w[tap + 6], w[tap + 7]
    r = rows[first * WIDE :]
    for x in range(WIDE):
        a, b, c, d = r[x], r[x + WIDE], r[x + 2 * WIDE], r[x + 3 * WIDE]
        e, f, g, h = r[x + 4 * WIDE], r[x + 5 * WIDE], r[x + 6 * WIDE], r[x + 7 * WIDE]
        i, j, k = r[x + 8 * WIDE], r[x + 9 * WIDE], r[x + 10 * WIDE]
        sums[x] += w0 * a + w1 * b + w2 * c + w3 * d + w4 * e + w5 * f + w6 * g + w7 * h
        sums[x + WIDE] += w0 * b + w1 * c + w2 * d + w3 * e + w4 * f + w5 * g + w6 * h + w7 * i
        sums[x + 2 * WIDE] += w0 * c + w1 * d + w2 * e + w3 * f + w4 * g + w5 * h + w6 * i + w7 * j
        sums[x + 3 * WIDE] += w0 * d + w1 * e + w2 * f + w3 * g + w4 * h + w5 * i + w6 * j + w7 * k


@inline
def _windows(source: Array, weights: Array, stride: int, rows: Array, sums: Array, out: Array) -> None:
    """Window sums along the rows of ``source`` [rows, cols] with weights [taps] into ``out`` [n, cols].

    ``taps`` is a multiple of TAPS, padded with zeros. ``rows`` and ``sums`` are scratch for strips of WIDE columns: in
    an array of their own, at constant distances, the compiler sees that sums and rows are apart, and vectorises.
    """
    count, cols = out.shape[0], out.shape[1]
    for x0 in range(0, cols, WIDE):
        wide = min(WIDE, cols - x0)
        for y in range(source.shape[0]):
            rows[y * WIDE : y * WIDE + wide] = source[y, x0 : x0 + wide]
        row = 0
        while row < count:
            sums[:] = 0
            together = 4 if stride == 1 and row + 4 <= count else 1
            for tap in range(0, weights.shape[0], TAPS):
                if together == 4:
                    _add_taps_to_four(sums, rows, row + tap, weights, tap)
                else:
                    _add_taps(sums, rows, row * stride + tap, weights, tap)
            for i in range(together):
                out[row + i, x0 : x0 + wide] = sums[i * WIDE : i * WIDE + wide]
            row += together


@jit
def moment_windows(
    maps: Array, over_time: Array, over_y: Array, over_x: Array, tall: Array, first: Array, wide: Array, stride: int,
    out: Array,
) -> None:  # fmt: skip
    """Structure tensors [entries, rows, cols] from the maps [5, maps, in_rows, in_cols] of 5 frames.

    ``over_time`` [3, 5], ``over_y``, ``over_x`` [3, taps]: window times powers of the offset. ``tall`` [n, 3]: map,
    power of t, power of y; ``wide`` [entries, 2]: power of x, entry; those of tall image i are first[i]..first[i + 1].
    """
    in_rows, in_cols = maps.shape[2], maps.shape[3]
    taps = over_y.shape[1]
    for i in prange(tall.shape[0]):
        plane, q, n = tall[i]
        rows = np.zeros((max(in_rows, in_cols) + 2 * taps) * WIDE, np.float32)
        sums = np.empty(4 * WIDE, np.float32)
        summed = np.empty((in_rows, in_cols), np.float32)
        w = over_time[q]
        for y in range(in_rows):
            _taps5(
                summed[y], maps[0, plane, y], maps[1, plane, y], maps[2, plane, y], maps[3, plane, y],
                maps[4, plane, y], w,
            )  # fmt: skip
        high = np.empty((out.shape[1], in_cols), np.float32)
        _windows(summed, over_y[n], stride, rows, sums, high)
        turned, found = high.T.copy(), np.empty((out.shape[2], out.shape[1]), np.float32)
        for k in range(first[i], first[i + 1]):
            _windows(turned, over_x[wide[k, 0]], stride, rows, sums, found)
            out[wide[k, 1]] = found.T


@inline
def _factor(A: Array, n: int) -> None:
    """Cholesky factor of A [n, n, LANES] in its lower triangle, the diagonal inverted."""
    for c in range(n):
        for r in range(c, n):
            total = A[r, c].copy()
            for k in range(c):
                for i in range(LANES):
                    total[i] -= A[r, k, i] * A[c, k, i]
            if r == c:
                for i in range(LANES):
                    A[c, c, i] = 1.0 / np.sqrt(max(total[i], 1e-290))
            else:
                for i in range(LANES):
                    A[r, c, i] = total[i] * A[c, c, i]


@inline
def _back(L: Array, X: Array, n: int, m: int) -> None:
    """``X := L^-T X`` for X [n, m, LANES]."""
    for step in range(n):
        r = n - 1 - step
        for k in range(r + 1, n):
            for c in range(m):
                for i in range(LANES):
                    X[r, c, i] -= L[k, r, i] * X[k, c, i]
        for c in range(m):
            for i in range(LANES):
                X[r, c, i] *= L[r, r, i]


@inline
def _forward(L: Array, X: Array, n: int, m: int) -> None:
    """``X := L^-1 X``."""
    for r in range(n):
        for k in range(r):
            for c in range(m):
                for i in range(LANES):
                    X[r, c, i] -= L[r, k, i] * X[k, c, i]
        for c in range(m):
            for i in range(LANES):
                X[r, c, i] *= L[r, r, i]


@inline
def _orthonormalise(X: Array, n: int, m: int) -> None:
    for c in range(m):
        for k in range(c + 1):
            overlap = np.zeros(LANES)
            for r in range(n):
                for i in range(LANES):
                    overlap[i] += X[r, k, i] * X[r, c, i]
            if k == c:
                overlap = 1.0 / np.sqrt(overlap)
            for r in range(n):
                for i in range(LANES):
                    X[r, c, i] = X[r, c, i] * overlap[i] if k == c else X[r, c, i] - overlap[i] * X[r, k, i]


@inline
def _small_jacobi(R: Array, V: Array, m: int) -> None:
    """Diagonalise R [m, m, LANES] by cyclic Jacobi, V its eigenvectors."""
    V[:] = 0
    for c in range(m):
        V[c, c] = 1
    for _ in range(SWEEPS):
        for p in range(m - 1):
            for q in range(p + 1, m):
                cos, sin = np.empty(LANES), np.empty(LANES)
                for i in range(LANES):
                    pq = R[p, q, i]
                    theta = (R[q, q, i] - R[p, p, i]) / (2 * pq + (1e-300 if pq >= 0 else -1e-300))
                    t = (1.0 if theta >= 0 else -1.0) / (abs(theta) + np.sqrt(theta * theta + 1))
                    cos[i] = 1 / np.sqrt(t * t + 1)
                    sin[i] = t * cos[i]
                for k in range(m):
                    for i in range(LANES):
                        one, two = R[k, p, i], R[k, q, i]
                        R[k, p, i], R[k, q, i] = cos[i] * one - sin[i] * two, sin[i] * one + cos[i] * two
                        one, two = V[k, p, i], V[k, q, i]
                        V[k, p, i], V[k, q, i] = cos[i] * one - sin[i] * two, sin[i] * one + cos[i] * two
                for k in range(m):
                    for i in range(LANES):
                        one, two = R[p, k, i], R[q, k, i]
                        R[p, k, i], R[q, k, i] = cos[i] * one - sin[i] * two, sin[i] * one + cos[i] * two


@jit
def null_space(J: Array, lower: Array, scale: Array, k: int, out: Array) -> None:
    """Equilibrated total least squares: parameters ``out`` [pixels, k, n - k], one time-like differential being 1.

    ``J`` [entries, pixels]; ``lower``: entry of each element of the lower triangle; ``scale`` [n].
    """
    n, pixels = scale.shape[0], J.shape[1]
    flow = n - k
    groups = (pixels + LANES - 1) // LANES
    n_tasks = min(groups, 64)
    for task in prange(n_tasks):
        A, X, Y = np.empty((n, n, LANES)), np.empty((n, BLOCK, LANES)), np.empty((n, BLOCK, LANES))
        R, V = np.empty((BLOCK, BLOCK, LANES)), np.empty((BLOCK, BLOCK, LANES))
        for group in range(task * groups // n_tasks, (task + 1) * groups // n_tasks):
            begin = min(group * LANES, pixels - LANES)  # the last group overlaps the one before
            at = 0
            for r in range(n):
                for c in range(r + 1):
                    row, s = J[lower[at]], scale[r] * scale[c]
                    for i in range(LANES):
                        A[r, c, i] = row[begin + i] * s
                    at += 1
            _factor(A, n)
            # The rows of the factor below the flow block are the forward solutions of the least-squares problems.
            for c in range(BLOCK):
                for r in range(n):
                    for i in range(LANES):
                        if c < k:
                            X[r, c, i] = -A[flow + c, r, i] if r < flow else (1.0 if r - flow == c else 0.0)
                        else:
                            X[r, c, i] = float((r * (5 + 2 * c) + 3 * c) % 7 - 3) + 0.5
            _back(A, X, flow, k)
            for _ in range(ITERATIONS):
                _forward(A, X, n, BLOCK)
                _back(A, X, n, BLOCK)
                _orthonormalise(X, n, BLOCK)
            Y[:] = 0
            for r in range(n):
                for m in range(r, n):
                    for c in range(BLOCK):
                        for i in range(LANES):
                            Y[r, c, i] += (1.0 / A[m, m, i] if m == r else A[m, r, i]) * X[m, c, i]
            R[:] = 0
            for r in range(n):
                for c in range(BLOCK):
                    for m in range(BLOCK):
                        for i in range(LANES):
                            R[c, m, i] += Y[r, c, i] * Y[r, m, i]
            _small_jacobi(R, V, BLOCK)
            _read_out(X, R, V, scale, k, out, begin)


@inline
def _read_out(X: Array, R: Array, V: Array, scale: Array, k: int, out: Array, begin: int) -> None:
    """Parameters of the k smallest Ritz vectors of each lane."""
    n = scale.shape[0]
    flow = n - k
    vectors, block = np.empty((n, k)), np.empty((k, k))
    for i in range(LANES):
        values = np.array([R[c, c, i] for c in range(BLOCK)])
        for j in range(k):
            best = np.argmin(values)
            values[best] = np.inf
            for r in range(n):
                total = 0.0
                for c in range(BLOCK):
                    total += X[r, c, i] * V[c, best, i]
                vectors[r, j] = total * scale[r]
        for r in range(k):
            for j in range(k):
                block[r, j] = vectors[flow + r, j]
        inverse = np.linalg.inv(block)
        for j in range(k):
            for r in range(flow):
                total = 0.0
                for m in range(k):
                    total += vectors[r, m] * inverse[m, j]
                out[begin + i, j, r] = total
