"""Windows that a mask or a border cuts: what takes the place of the moments of whole ones, by direct float64 sums."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from reference import cells, chain

from leafflow_ti.kernels.cut import UNLIKE
from leafflow_ti.models import ColumnSet
from leafflow_ti.sampling import Sampling, pixel_factor


@dataclass(frozen=True)
class Cut:
    """``noise`` [N, N]: covariance of the columns' noise; ``share`` of the window that is seen; ``spread`` and
    ``ratio`` [n_flow, n_flow]: of the moments of w² and w, relative to those of the whole window, and to the former;
    ``curved`` [3, 3]: x², xy, y² (columns) projected on 1, x, y."""

    noise: np.ndarray
    share: float
    spread: float
    ratio: np.ndarray
    curved: np.ndarray

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
        powers = [c.terms[0].exponents[:2] for c in columns.columns[: columns.n_flow]]

        def moment(w, one, two):
            return float(np.sum(w * grids["x"] ** (one[0] + two[0]) * grids["y"] ** (one[1] + two[1])))

        def ratio(one, two):
            plain, double = (
                (moment(w, one, one) * moment(w, two, two)) ** 0.5 for w in (weights, squared)
            )
            alike, alike_squared = moment(weights, one, two) / plain, moment(squared, one, two) / double
            found = double / plain * (alike * alike_squared + UNLIKE) / (alike**2 + UNLIKE)
            return found / (pixel_factor(sampling.x, one[0], two[0]) * pixel_factor(sampling.y, one[1], two[1]))

        spread = ratio((0, 0), (0, 0))
        affine = all(columns.index("x", a) is not None for a in "xy")
        return cls(
            noise, float(weights.sum()), spread, np.array([[ratio(a, b) for b in powers] for a in powers]) / spread,
            curved(grids, weights, affine),
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
