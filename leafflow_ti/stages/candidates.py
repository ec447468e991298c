"""Candidate motions of square tiles: from correlations of the images, and from what pixels chose before."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.stages.search import Image, Labels

Candidates = NDArray[np.int64]
"""[n, 2] (x, y) of one tile, the most promising first."""

SLOTS = 32
"""Labels at most among which a pixel chooses."""
CANDIDATE_TILE, CORRELATED, PEAKS = 32, 64, 6
"""Correlations: distance and size [px] of their windows, peaks of each."""
OWN, OTHERS = 12, 4
"""Candidates that a tile takes from itself and from each tile around it."""


def proposals(stack: Image, signs: list[int], reach: int) -> list[Candidates]:
    """Candidates of each tile of ``CANDIDATE_TILE`` px: highest peaks of local correlations, up to ``reach`` px.

    A window of ``CORRELATED`` px around the tile is correlated with the other images.

    ``stack`` [1 + others, 2, rows, cols] features, the reference first; ``signs`` of the others: 1 for an image that
    sees motions forward, -1 for one that sees them backward. Motions that both confirm have the higher peaks.
    """
    rows, cols = stack.shape[2:]
    half, size = CORRELATED // 2, CORRELATED + 2 * reach
    pad = half + reach
    hann = np.sin(np.pi * (np.arange(CORRELATED) + 0.5) / CORRELATED) ** 2
    window = np.outer(hann, hann)
    # The product of one complex number and another's conjugate holds the products of their gradients.
    here, *there = (np.pad(image[0] + 1j * image[1], pad) for image in stack)
    found = []
    for y in range(CANDIDATE_TILE // 2, rows + CANDIDATE_TILE // 2, CANDIDATE_TILE):
        for x in range(CANDIDATE_TILE // 2, cols + CANDIDATE_TILE // 2, CANDIDATE_TILE):
            top, left = min(y, rows - 1) + reach, min(x, cols - 1) + reach
            part = np.zeros((size, size), np.complex128)
            part[:CORRELATED, :CORRELATED] = here[top : top + CORRELATED, left : left + CORRELATED] * window
            spectrum = np.conj(np.fft.fft2(part))
            total = np.zeros((2 * reach + 1, 2 * reach + 1))
            for image, sign in zip(there, signs, strict=True):
                block = image[top - reach : top - reach + size, left - reach : left - reach + size]
                # Cyclic, and free of wrapping for the lags up to twice ``reach`` that are kept.
                lags = np.fft.ifft2(spectrum * np.fft.fft2(block)).real[: 2 * reach + 1, : 2 * reach + 1]
                total += lags if sign > 0 else lags[::-1, ::-1]
            found.append(_peaks(total, PEAKS) - reach)
    return found


def _peaks(values: NDArray[np.float64], most: int) -> Candidates:
    """The highest local maxima, [n, 2] (x, y), highest first."""
    padded = np.pad(values, 1, constant_values=-np.inf)
    rows, cols = values.shape
    around = [padded[j : j + rows, i : i + cols] for j in range(3) for i in range(3) if (j, i) != (1, 1)]
    y, x = np.nonzero(values > np.max(around, axis=0))
    order = np.argsort(-values[y, x], kind="stable")[:most]
    return np.stack([x[order], y[order]], axis=1)


def votes(displacement: Image, tile: int) -> list[Candidates]:
    """Displacements [2, rows, cols] that pixels of each tile of ``tile`` px chose, rounded, most frequent first."""
    whole = np.rint(displacement).astype(np.int64)
    found = []
    for y in range(0, whole.shape[1], tile):
        for x in range(0, whole.shape[2], tile):
            values, counts = np.unique(whole[:, y : y + tile, x : x + tile].reshape(2, -1), axis=1, return_counts=True)
            found.append(values[:, np.argsort(-counts, kind="stable")].T)
    return found


def tiled(candidates: list[Candidates], tile: int, shape: tuple[int, ...], reach: int, unit: float = 1.0) -> Labels:
    """Labels of each tile: its own candidates, none at all, those of the tiles around, then the neighbours of all.

    ``SLOTS`` at most, and none longer than ``reach`` px along x or y. Candidates are in units of ``unit`` px; ``shape``
    (rows, cols) [px].
    """
    tiles_y, tiles_x = -(-shape[0] // tile), -(-shape[1] // tile)
    count = np.zeros(tiles_y * tiles_x, np.int32)
    values = np.zeros((tiles_y * tiles_x, SLOTS, 2))
    steps = np.array([(i, j) for j in (-1, 0, 1) for i in (-1, 0, 1)])
    for here in range(len(count)):
        row, col = divmod(here, tiles_x)
        around = [
            candidates[j * tiles_x + i]
            for j in range(max(row - 1, 0), min(row + 2, tiles_y))
            for i in range(max(col - 1, 0), min(col + 2, tiles_x))
            if (j, i) != (row, col)
        ]
        near = np.concatenate([candidates[here][:OWN], np.zeros((1, 2), np.int64), *(c[:OTHERS] for c in around)])
        wide = (near[:, None] + steps).reshape(-1, 2)
        every = np.concatenate([near, wide[np.abs(wide).max(axis=1) * unit <= reach]])
        _, first = np.unique(every, axis=0, return_index=True)
        chosen = every[np.sort(first)[:SLOTS]]
        count[here] = len(chosen)
        values[here, : len(chosen)] = unit * chosen
    return Labels(tile, tiles_x, count, values, unit)
