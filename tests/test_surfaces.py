"""Surfaces of a frame: labels, layers, and what hides what, beside naive loops."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from leafflow_ti.aim import Aim
from leafflow_ti.reading import Box
from leafflow_ti.search import Coarse, Extent
from leafflow_ti.surfaces import EDGE, REACH, Surfaces, dilated, vector

SHAPE = (40, 60)
BASELINE = (5.0, -2.5)


def two_leaves(device: Callable, cameras: tuple[int, int] = (3, 5)) -> Surfaces:
    """A ground at -4 px/step, a leaf before it at -9.3 that moves by (2, -1), and one at -6.2, tilted, that rests.

    ``cameras``: rows, columns. Pixels of one corner are not known.
    """
    disparity, motion = np.full(SHAPE, -4.0, np.float32), np.zeros((2, *SHAPE), np.float32)
    y, x = np.indices(SHAPE)
    tilted, near = (y > 4) & (y < 20) & (x > 30) & (x < 55), (y > 12) & (y < 30) & (x > 12) & (x < 36)
    disparity[tilted] = (-6.2 + 0.05 * (x - 40))[tilted]
    disparity[near] = -9.3
    motion[0][near], motion[1][near] = 2.0, -1.0
    known = np.ones(SHAPE, bool)
    known[:5, :5] = False
    rows, cols = cameras
    if rows * cols == 1:
        disparity[:] = 0
    if cols == 1:  # along y the baseline is negative, and so what is nearer moves on
        disparity *= -1
    extent = Extent(5, rows, cols, *SHAPE, BASELINE)
    return Surfaces(
        device("f32"), Coarse(disparity, motion, known), extent, (range(rows), range(cols)), (rows // 2, cols // 2)
    )


def hidden_naively(surfaces: Surfaces, aim: Aim, elapsed: float, box: Box, cameras: tuple[int, int]) -> np.ndarray:
    """What is nearer by more than ``REACH``, known, and lands within a pixel of a pixel of the block."""
    rows, cols = cameras
    found = np.zeros((rows, cols, box.rows, box.cols), bool)
    u0, v0, p0, q0 = vector(aim)
    for y, x in np.argwhere(surfaces.known):
        u, v, p, q = surfaces.shown[:, y, x]
        nearer = (v - v0) if cols == 1 else (u0 - u)
        hides = nearer > REACH if rows * cols > 1 else max(abs(p - p0), abs(q - q0)) > REACH
        if not hides:
            continue
        for row in range(rows):
            for col in range(cols):
                i, j = col - cols // 2, row - rows // 2
                at_x = x - box.x + int(np.floor((u - u0) * i + (p - p0) * elapsed + 0.5))
                at_y = y - box.y + int(np.floor((v - v0) * j + (q - q0) * elapsed + 0.5))
                found[row, col, max(at_y - 1, 0) : max(at_y + 2, 0), max(at_x - 1, 0) : max(at_x + 2, 0)] = True
    return found


def assert_hidden_equals_naive(device: Callable, cameras: tuple[int, int]) -> None:
    surfaces, box = two_leaves(device, cameras), Box(-3, 2, 35, 50)
    covered = 0
    for aim in surfaces.aims:
        for elapsed in (-1.5, 0.0, 2.0):
            wanted = hidden_naively(surfaces, aim, elapsed, box, cameras)
            found = surfaces.hidden(aim, elapsed, box)
            np.testing.assert_array_equal(np.zeros_like(wanted) if found is None else found, wanted)
            covered += np.count_nonzero(wanted)
    assert covered > 0


@pytest.mark.parametrize("cameras", [(3, 5), (1, 5), (5, 1), (1, 1)])
def test_hidden_equals_naive_loops(device: Callable, cameras: tuple[int, int]) -> None:
    assert_hidden_equals_naive(device, cameras)


def test_nothing_hides_the_nearest(device: Callable) -> None:
    surfaces = two_leaves(device)
    nearest = min(surfaces.aims, key=lambda aim: aim.shift[0])
    assert surfaces.hidden(nearest, 1.0, Box(0, 0, *SHAPE)) is None


def test_labels_are_the_nearest_whole_pixels_of_both_axes_and_of_the_motion(device: Callable) -> None:
    surfaces = two_leaves(device)
    assert Aim((-4, 2), (0, 0)) in surfaces.aims
    assert (
        Aim((-9, 5), (2, -1)) in surfaces.aims
    )  # 9.3 px along x are -4.65 along y, where the baseline is half as long
    for number, aim in enumerate(surfaces.aims):
        away = np.abs(surfaces.shown[:, surfaces.number == number] - vector(aim)[:, None])
        assert away.max() <= 0.5 + 1e-6


def test_rare_labels_join_the_nearest(device: Callable) -> None:
    disparity = np.full(SHAPE, -4.0, np.float32)
    disparity[3, 3:9] = -5.4
    extent = Extent(1, 1, 5, *SHAPE, BASELINE)
    coarse = Coarse(disparity, np.zeros((2, *SHAPE), np.float32), np.ones(SHAPE, bool))
    surfaces = Surfaces(device("f32"), coarse, extent, (range(1), range(5)), (0, 2))
    assert surfaces.aims == [Aim((-4, 0), (0, 0))]


def test_a_layer_is_what_lies_within_reach_without_its_outermost_pixel(device: Callable) -> None:
    surfaces, box = two_leaves(device), Box(-2, -2, 44, 64)
    for aim in surfaces.aims:
        inside = (np.abs(surfaces.shown - vector(aim)[:, None, None]).max(axis=0) <= REACH) & surfaces.known
        wanted = np.pad(inside & ~dilated(~inside, 1), 2)
        np.testing.assert_array_equal(surfaces.layer([aim], box), wanted)


def test_edges_are_where_displacements_jump(device: Callable) -> None:
    surfaces = two_leaves(device)
    edges = surfaces.near_edges(2)
    y, x = np.indices(SHAPE)
    beside = (np.abs(x - 12.5) <= 2) & (y >= 13) & (y < 30)  # left edge of the near leaf
    assert edges[beside].all()
    assert not edges[34:].any()
    assert not edges[:3, :28].any()


def test_labels_are_offered_around_their_pixels(device: Callable) -> None:
    """Whatever pixels are asked for: every other one of a few rows and columns, beside naive loops."""
    surfaces = two_leaves(device)
    y, x = range(3, 33, 2), range(21, 60, 3)
    offered = dict(surfaces.offered(y, x))
    assert len(offered) > 2
    for label in range(len(surfaces.aims)):
        for i, j in np.ndindex(len(y), len(x)):
            rows, cols = (slice(max(0, n - EDGE), n + EDGE + 1) for n in (y[i], x[j]))
            around = (surfaces.number[rows, cols] == label).any()
            assert around == (label in offered and offered[label][i, j])
