"""Cells of a window: the parts whose samples share a weight, each with a tensor of its own.

A cell is a block of pixels with all its camera and time samples, or in the exact form a single sample. Naive float64
sums; tables (columns, filters, window weights, noise gains) come from the library.
"""

from dataclasses import dataclass
from functools import partial

import numpy as np
from reference import chain

from leafflow_ti.models import ColumnSet
from leafflow_ti.sampling import Sampling

Array = np.ndarray


@dataclass(frozen=True)
class Cells:
    """Cells of one window: ``J`` and ``C`` [cells, N, N], ``w`` [cells]; ``noise`` [N] is the diagonal of C̄;
    ``distance`` [cells]: squared, from the middle of the window, relative to its second moment along x and y."""

    J: Array
    w: Array
    C: Array
    columns: ColumnSet
    noise: Array
    distance: Array

    @classmethod
    def of(cls, vectors, seen, sampling: Sampling, columns: ColumnSet, exact=False):
        """From data vectors and the samples that count, as ``chain.window_of`` has them."""
        whole = np.ones_like(seen)
        C = cell_sums(noise_vectors(sampling, columns), whole, sampling, exact)
        mass = partial(cell_sums, [np.ones((1, *vectors[0].shape[1:]))], sampling=sampling, exact=exact)
        return cls(
            cell_sums(vectors, seen, sampling, exact), mass(seen=seen)[:, 0, 0], C / mass(seen=whole), columns,
            chain.column_noise(sampling, columns), distances(sampling, exact),
        )  # fmt: skip

    @classmethod
    def at(cls, images, sampling: Sampling, columns: ColumnSet, pixel, valid=None, exact=False):
        """Of the window around a pixel (x, y) of images [t, sy, sx, y, x]; ``valid`` [t, y, x]."""
        return cls.of(*chain.window_of(images, sampling, columns, pixel, valid), sampling, columns, exact)

    @property
    def tensor(self):
        """J [N, N] of the window."""
        return self.J.sum(axis=0)


def window(images, sampling: Sampling, columns: ColumnSet, at, valid, cells):
    """J [N, N] or, with ``cells``, the cells of the window around the pixel ``at`` (x, y), and ρ.

    With J, ρ over the share of the window that is seen: by so much the variance of its residual is too small.
    """
    rho = chain.texture_smoothness(images, sampling, *at, valid)
    if cells:
        return Cells.at(images, sampling, columns, at, valid), rho
    _, seen = chain.window_of(images, sampling, columns, at, valid)
    share = float(np.sum(chain.window_weights(sampling) * seen))
    return chain.structure_tensor(images, sampling, columns, [at], valid)[0], rho / share


def noise_vectors(sampling: Sampling, columns: ColumnSet):
    """g [N, t, sy, sx, y, x] of every channel of every data vector: the noise covariance (2.24) of d is Σ g g^T."""
    grids = chain.offsets(sampling)
    found = {}
    for i, column in enumerate(columns.columns):
        for term in column.terms:
            g = found.setdefault((term.channel, term.vector), np.zeros((columns.n, *grids["t"].shape)))
            derived = columns.derived.get(term.channel)
            gain = derived.gain if derived else channel_gains(sampling, term.channel)
            g[i] += term.factor * np.sqrt(gain) * chain.monomial(grids, term.exponents)
    return list(found.values())


def channel_gains(sampling: Sampling, channel):
    """Noise gain of a channel at every sample [t, sy, sx, y, x]."""
    gains = (sampling.axis(a).gains(a == channel) for a in chain.ARRAY_AXIS)
    return np.einsum("i,j,k,l,m", *gains)


def cell_sums(vectors, seen, sampling: Sampling, exact):
    """Σ w d d^T over the samples of every cell [cells, n, n] of vectors d [n, t, sy, sx, y, x]."""
    if exact:
        weights = (chain.window_weights(sampling) * seen).ravel()
        flat = [d.reshape(len(d), -1).T for d in vectors]
        return sum(weights[:, None, None] * d[:, :, None] * d[:, None, :] for d in flat)
    series = np.einsum("i,j,k", *(np.array(sampling.axis(a).weights) for a in ("t", "sy", "sx")))
    total = 0.0
    for d in vectors:
        # One matrix product for each pixel: [y, x, n, samples] by [y, x, samples, n].
        weighted = d * (series[..., None, None] * seen)
        one, two = (np.moveaxis(a.reshape(len(d), -1, *d.shape[4:]), (2, 3), (0, 1)) for a in (weighted, d))
        total = total + one @ np.swapaxes(two, 2, 3)
    cells = np.einsum("by,ax,yxij->baij", block_weights(sampling.y), block_weights(sampling.x), total, optimize=True)
    return cells.reshape(-1, *cells.shape[2:])


def distances(sampling: Sampling, exact):
    """Squared distance [cells] of cells from the middle of the window, x and y relative to the window's moments."""
    if exact:
        grids = chain.offsets(sampling)
        return sum(grids[a].ravel() ** 2 / sampling.axis(a).moment(2) for a in ("x", "y"))
    y, x = (sampling.axis(a).blocked.centres ** 2 / sampling.axis(a).moment(2) for a in ("y", "x"))
    return np.add.outer(y, x).ravel()


def block_weights(axis):
    """Weights [blocks, samples] that the blocks of an axis give to its samples."""
    blocks = axis.blocked
    found = np.zeros((len(blocks.weights), axis.size))
    for b, weight in enumerate(blocks.weights):
        found[b, b * blocks.step : b * blocks.step + blocks.length] = weight * np.array(blocks.shape)
    return found
