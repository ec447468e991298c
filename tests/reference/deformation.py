"""Naive float64 twin of the virtual strain gauge: one pixel and one pair at a time, its errors by differencing."""

from itertools import pairwise

import numpy as np


def connected(links, start, allowed, thin):
    """Pixels of ``allowed`` that a chain of linked neighbours, ``thin`` apart, joins with ``start``."""
    found, open_ends = {start}, [start]
    while open_ends:
        p = open_ends.pop()
        for q in ((p[0] - thin, p[1]), (p[0] + thin, p[1]), (p[0], p[1] - thin), (p[0], p[1] + thin)):
            if q in allowed and q not in found and frozenset((p, q)) in links:
                found.add(q)
                open_ends.append(q)
    return sorted(found)


def plane_weights(pixels, pitch):
    """Weights [n, 2] of the values at ``pixels`` in the slopes along x and y of their least-squares plane."""
    A = np.array([[1.0, pitch * col, pitch * row] for row, col in pixels])
    return np.linalg.pinv(A)[1:].T


def deform(c, s, f):
    """Strain (11, 22, 12) and area rate, %/frame, of positions and velocities [n, 3] with weights c [n, 2]."""
    element, change = s.T @ c, f.T @ c  # columns: along x, along y
    normal = np.cross(element[:, 0], element[:, 1])
    one = np.cross([0.0, 1.0, 0.0], normal)
    two = np.cross(normal, one)
    T = np.stack([one / np.linalg.norm(one), two / np.linalg.norm(two)])
    to_tangents = np.linalg.inv(T @ element)
    before, after = ((element + half * change) @ to_tangents for half in (-0.5, 0.5))
    L = before.T @ before
    values, vectors = np.linalg.eigh(L)
    root = vectors @ np.diag(values**-0.5) @ vectors.T
    E = 0.5 * (root @ after.T @ after @ root - np.eye(2))
    area = np.sqrt(np.linalg.det(after.T @ after) / np.linalg.det(L)) - 1
    return 100 * np.array([E[0, 0], E[1, 1], E[0, 1], area])


def strain(at, s, f, covariance, rays, known, links, half, thin, pitch, correlation):
    """Values and standard errors [n, 4] of strain 11, 22, 12 and area rate, at the pixels ``at`` [n, 2].

    ``covariance`` [3, 3] of the image's motion m, the same everywhere; ``links``: pairs of pixels on one surface;
    ``correlation(n)``: of errors n output pixels apart.
    """
    h, w = known.shape
    values, errors = np.full((len(at), 4), np.nan), np.full((len(at), 4), np.nan)
    for number, (row, col) in enumerate(at):
        # Neighbours of the lattice are linked where all pixels between them are.
        steps = [(row + thin * i, col + thin * j) for i in range(-half, half + 1) for j in range(-half, half + 1)]
        lattice = {p for p in steps if 0 <= p[0] < h and 0 <= p[1] < w and known[p]}
        joined = set()
        for p in lattice:
            for down, right in ((1, 0), (0, 1)):
                chain = [(p[0] + k * down, p[1] + k * right) for k in range(thin + 1)]
                if all(frozenset(pair) in links for pair in pairwise(chain)):
                    joined.add(frozenset((chain[0], chain[-1])))
        pixels = connected(joined, (row, col), lattice, thin)
        spread = np.array(pixels, float) - np.mean(pixels, axis=0)
        if len(pixels) < 3 or np.linalg.matrix_rank(spread, tol=0.3 * thin) < 2:
            errors[number] = np.inf
            continue
        c = plane_weights(pixels, pitch)
        S, F = (np.array([field[p] for p in pixels]) for field in (s, f))
        values[number] = deform(c, S, F)
        gradient = np.zeros((len(pixels), 3, 4))
        for i, p in enumerate(pixels):
            M = np.array([[1, 0, rays[p][0]], [0, 1, rays[p][1]], [0, 0, 1.0]])
            for k in range(3):
                step = np.zeros_like(F)
                step[i] = 1e-5 * M[:, k]
                gradient[i, k] = (deform(c, S, F + step) - deform(c, S, F - step)) / 2e-5
        R = np.array([[correlation(abs(p[0] - q[0])) * correlation(abs(p[1] - q[1])) for q in pixels] for p in pixels])
        errors[number] = np.sqrt(np.einsum("ika,ij,kl,jla->a", gradient, R, covariance, gradient))
    return values, errors
