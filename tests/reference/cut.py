"""Windows that a mask or a border cuts: what takes the place of the moments of whole ones, by direct float64 sums."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from reference import cells, chain

from leafflow_ti.models import ColumnSet
from leafflow_ti.sampling import Sampling, pixel_factor


@dataclass(frozen=True)
class Cut:
    """``noise`` [N, N]: covariance of the columns' noise; ``share`` of the window that is seen; ``spread``: the ratio
    of the sums of w² and w, relative to that of the whole window; ``turn`` [n_flow, n_flow]: B with ``B J_ff B^T`` the
    sum over w² where the texture is the same everywhere, per that ratio; ``curved`` [3, 3]: x², xy, y² (columns)
    projected on 1, x, y; ``centroid`` (x, y) px from the pixel."""

    noise: np.ndarray
    share: float
    spread: float
    turn: np.ndarray
    curved: np.ndarray
    centroid: tuple[float, float]

    @classmethod
    def of(cls, seen, sampling: Sampling, columns: ColumnSet) -> Cut:
        """For samples [t, 1, 1, y, x] that count."""
        grids, shape = chain.offsets(sampling), chain.window_weights(sampling).shape
        weights = chain.window_weights(sampling) * seen
        squared = np.broadcast_to(_squared(sampling) * seen, shape)
        noise = sum(
            np.einsum("atuvyx,btuvyx,tuvyx->ab", g, g, weights, optimize=True)
            for g in cells.noise_vectors(sampling, columns)
        )
        flow = columns.columns[: columns.n_flow]
        shapes = [shape_values(c, grids) for c in flow]
        distinct = [np.ones(shape), *shapes]
        order = [0, *(1 + i for i, s in enumerate(shapes) if not any(np.array_equal(s, o) for o in distinct[: 1 + i]))]
        W, W2 = (np.array([[np.sum(w * distinct[i] * distinct[j]) for j in order] for i in order])
                 for w in (weights, squared))  # fmt: skip
        X = np.linalg.inv(np.linalg.cholesky(W)).T @ np.linalg.cholesky(W2).T
        B = np.zeros((len(flow), len(flow)))
        for i, one in enumerate(flow):
            for j, two in enumerate(flow):
                if (one.channel, one.terms[0].exponents[2:]) == (two.channel, two.terms[0].exponents[2:]):
                    a, b = (
                        next(k for k, o in enumerate(order) if np.array_equal(distinct[o], shapes[n])) for n in (i, j)
                    )
                    B[i, j] = X[b, a] / X[0, 0]
        affine = all(columns.index("x", a) is not None for a in "xy")
        whole = pixel_factor(sampling.x, 0, 0) * pixel_factor(sampling.y, 0, 0)
        centroid = tuple(float(np.sum(weights * grids[a]) / weights.sum()) for a in "xy")
        return cls(noise, float(weights.sum()), X[0, 0] ** 2 / whole, B, curved(grids, weights, affine), centroid)


def shape_values(column, grids):
    """What a column depends on x and y by, at every sample."""
    others = column.terms[0].exponents[2:]
    return sum(
        t.factor * grids["x"] ** t.exponents[0] * grids["y"] ** t.exponents[1]
        for t in column.terms if t.exponents[2:] == others
    )  # fmt: skip


def _squared(sampling: Sampling):
    """Weights [t, sy, sx, y, x], squared along x and y; of blocks, whose samples share a weight, those of each."""
    along = [np.array(sampling.axis(a).weights) for a in ("t", "sy", "sx")]
    for a in ("y", "x"):
        blocks = cells.block_weights(sampling.axis(a))
        along.append(np.array(sampling.axis(a).blocked.weights) @ blocks)
    return np.einsum("i,j,k,l,m", *along)


def curved(grids, weights, affine):
    """x², xy, y² projected on 1, x, y (or on 1 alone) by weighted least squares."""
    x, y, w = (a.ravel() for a in (grids["x"], grids["y"], weights))
    basis = np.stack([np.ones_like(x), x, y])[: 3 if affine else 1]
    parts = np.stack([x**2, x * y, y**2])
    found = np.zeros((3, 3))
    found[: len(basis)] = np.linalg.solve((basis * w) @ basis.T, (basis * w) @ parts.T)
    return found
