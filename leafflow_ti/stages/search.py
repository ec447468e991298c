"""Host side of the search among candidate displacements: features, tables of labels, launches.

A search is given by *labels* (candidates per tile), *views* (images with the factors that turn a label into their
displacement) and penalties; see ``kernels.search``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.runtime import Device
from leafflow_ti.stages.planes import round_up

Image = NDArray[np.float32]
DIRECTIONS = ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (-1, -1), (1, -1), (-1, 1))
"""Steps (y, x) of the paths."""
STEPS = ((0, 0), (-1, 0), (1, 0), (0, -1), (0, 1), (-1, -1), (1, -1), (-1, 1), (1, 1))
"""Steps (x, y) from a label to those that count as neighbours, itself the first."""
NEAR = len(STEPS)


@dataclass(frozen=True)
class Costs:
    """How labels are rated.

    ``radius`` [px] of the windows in which gradients are normalised; ``most`` largest difference that counts, in units
    of the normalised gradient; ``small`` penalty between neighbouring labels; ``large`` between other labels, halved
    where neighbouring grey values differ by ``edge`` times what is typical; ``support`` [px] radius of a pixel's
    support, in which weights fall by e where grey values differ by ``alike`` times what is typical. A pixel is
    explained by a cost below ``likely``.
    """

    radius: int = 12
    most: float = 0.8
    small: float = 0.3
    large: float = 2.0
    support: int = 2
    alike: float = 3.0
    edge: float = 1.0
    likely: float = 0.44


@dataclass(frozen=True, eq=False)
class Labels:
    """Candidate displacements of square tiles of ``tile`` px, ``tiles_x`` in a row of tiles.

    ``count`` int [tiles]; ``values`` float [tiles, slots, 2] (x, y), distinct in each tile, only the first ``count``
    hold; ``step`` distance of labels that count as neighbours, along x and y. ``line``: the labels lie in this order on
    one line of the plane; else on a grid of this step.
    """

    tile: int
    tiles_x: int
    count: NDArray[np.int32]
    values: NDArray[np.float64]
    step: float
    line: bool = False

    @property
    def slots(self) -> int:
        """Labels per tile at most."""
        return int(self.values.shape[1])

    def padded(self, multiple: int) -> Labels:
        """The same labels in a number of slots that is a multiple of this."""
        more = round_up(self.slots, multiple) - self.slots
        return replace(self, values=np.pad(self.values, ((0, 0), (0, more), (0, 0))))

    def near(self) -> NDArray[np.int32]:
        """[tiles, 9, slots, NEAR]: slots of the labels a step away, in the order of ``STEPS``, in the tiles around.

        The tiles stand row by row, the fifth is the tile itself; -1 where there is no such label. Not filled for labels
        on a line.
        """
        tiles, slots = len(self.count), self.slots
        table = np.full((tiles, 9, slots, NEAR), -1, np.int32)
        if self.line:
            return table
        # A label as one number, with its tile: what is looked for is found in the sorted list of all.
        place = np.rint(self.values / self.step).astype(np.int64)
        side = 2 * int(np.abs(place).max()) + 5
        code = place[..., 0] * side + place[..., 1] + side * side // 2
        there = np.arange(slots) < self.count[:, None]
        keys = np.where(there, np.arange(tiles)[:, None] * side * side + code, tiles * side * side).ravel()
        order = np.argsort(keys, kind="stable")
        ordered = keys[order]
        index = np.arange(tiles).reshape(-1, self.tiles_x)
        padded = np.pad(index, 1, constant_values=-1)
        for relation in range(9):
            dy, dx = divmod(relation, 3)
            other = padded[dy : dy + index.shape[0], dx : dx + index.shape[1]].ravel()
            for n, (x, y) in enumerate(STEPS):
                wanted = other[:, None] * side * side + code + x * side + y
                found = np.minimum(np.searchsorted(ordered, wanted), ordered.size - 1)
                hit = there & (other >= 0)[:, None] & (ordered[found] == wanted)
                table[:, relation, :, n] = np.where(hit, order[found] % slots, -1)
        return table


@dataclass(frozen=True, eq=False)
class Views:
    """Images beside the reference, arm by arm: ``factors`` [views, 2] (x, y) of the label, ``arms`` first view of each
    arm and the end."""

    factors: NDArray[np.float64]
    arms: NDArray[np.int32]

    @classmethod
    def of(cls, arms: list[list[tuple[float, float]]]) -> Views:
        """From the factors of the views of each arm."""
        flat = [f for arm in arms for f in arm]
        return cls(np.array(flat, np.float64), np.cumsum([0] + [len(a) for a in arms]).astype(np.int32))


@dataclass(frozen=True, eq=False)
class Found:
    """Per pixel: ``slot`` of the best label, ``displacement`` [2, H, W] with fraction, and its own ``cost``."""

    slot: NDArray[np.int32]
    displacement: Image
    cost: Image


def box_mean(image: NDArray[Any], radius: int) -> NDArray[np.float64]:
    """Mean over squares of (2 radius + 1)² px; over what of them lies inside the image. [H, W]"""
    result = image.astype(np.float64)
    for axis in range(2):
        n = result.shape[axis]
        total = np.concatenate([np.zeros_like(result.take([0], axis)), np.cumsum(result, axis)], axis)
        end, begin = np.minimum(np.arange(n) + radius + 1, n), np.maximum(np.arange(n) - radius, 0)
        width = (end - begin).reshape((-1, 1) if axis == 0 else (1, -1))
        result = (total.take(end, axis) - total.take(begin, axis)) / width
    return result


def features(image: Image, radius: int, floor: float) -> Image:
    """[2, H, W]: the gradient (x, y) in units of its root mean square over windows of ``radius`` px.

    A gradient changes within a pixel of a surface's edge, where a window would reach across; the ratio does not depend
    on slow changes of the light. ``floor`` [grey]: standard deviation of the noise; where the gradient is no more than
    that of noise, features fade to 0.
    """
    along_y, along_x = (np.asarray(g) for g in np.gradient(image.astype(np.float64)))
    energy = box_mean(along_x**2 + along_y**2, radius) / 2.0
    scale = 1.0 / np.sqrt(energy + floor**2 / 2.0)  # central differences halve the variance of noise
    return np.stack([along_x * scale, along_y * scale]).astype(np.float32)


def search(
    device: Device, stack: Image, guide: Image, mask: NDArray[np.bool_], views: Views, labels: Labels, costs: Costs
) -> Found:
    """The best label of each pixel.

    ``stack`` [1 + views, channels, H, W] features, the reference first; ``guide`` [H, W] the image whose edges may be
    edges of surfaces, in units of a typical difference of neighbours; ``mask`` [H, W]: pixels that count.
    """
    from leafflow_ti.kernels.search import costs_kernel, paths_kernel, winners_kernel
    from leafflow_ti.kernels.search_support import support_kernel

    spec = device.moments
    labels = labels.padded(spec.lanes)
    _, channels, rows, cols = stack.shape
    size, slots = rows * cols, labels.slots
    tables = (device.array(labels.count, "int"), device.array(labels.values))
    n_arms, n_tasks, side = len(views.arms) - 1, device.tasks(size), 2 * costs.support + 1
    arm_cost, cost, total = device.empty(n_arms * size * slots), device.empty(size * slots), device.zeros(size * slots)
    costs_kernel(spec)(
        rows, cols, channels, n_arms, labels.tile, labels.tiles_x, slots, costs.most, n_tasks, *tables,
        device.array(views.arms, "int"), device.array(views.factors), device.array(stack), arm_cost,
    )  # fmt: skip
    near, greys = device.array(labels.near(), "int"), device.array(guide)
    scratch = (size if device.gpu else n_tasks) * side**2
    support_kernel(spec)(
        rows, cols, n_arms, costs.support, labels.tile, labels.tiles_x, slots, costs.alike, n_tasks, near, greys,
        device.array(mask, "int"), arm_cost, device.vectors(arm_cost, spec.lanes), device.empty(2 * scratch, "int"),
        device.empty(scratch), device.vectors(cost, spec.lanes),
    )  # fmt: skip
    most_lines = rows + cols - 1
    behind = device.empty(2 * most_lines * slots)
    for step_y, step_x in DIRECTIONS:
        n_lines = rows if step_y == 0 else cols if step_x == 0 else most_lines
        paths_kernel(spec)(
            n_lines, rows, cols, step_y, step_x, labels.tile, labels.tiles_x, slots, int(labels.line),
            costs.small, costs.large, costs.edge, device.tasks(n_lines), tables[0], near, greys, cost, behind, total,
        )  # fmt: skip
    chosen, found, price = device.empty(size, "int"), device.empty(2 * size), device.empty(size)
    winners_kernel(spec)(
        rows, cols, labels.tile, labels.tiles_x, slots, int(labels.line), device.tasks(size),
        *tables, near, cost, total, chosen, found, price,
    )  # fmt: skip
    return Found(
        device.host(chosen).reshape(rows, cols),
        device.host(found).reshape(2, rows, cols).astype(np.float32),
        device.host(price).reshape(rows, cols).astype(np.float32),
    )
