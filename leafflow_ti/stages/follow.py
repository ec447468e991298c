"""Dense flow of all images of a sequence by following every pixel through them, coarse to fine.

Each step moves the images by the flow found so far, and fits a flow that is constant or affine in a window to what is
left, *plus* the flow that was taken out pixel by pixel. So windows are not applied again and again (which would undo
them and raise the noise), and noise in the gradients slows convergence but leads to no bias: at the end nothing is left
to be explained.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.filters import gaussian_weights
from leafflow_ti.kernels.warp_planes import LEVER, MARGIN, TEXTURE
from leafflow_ti.runtime import Device
from leafflow_ti.splines import filter_taps
from leafflow_ti.stages.planes import Filtering, round_up

Array = NDArray[Any]
LANES = 64
"""Rows of planes have a multiple of so many pixels."""
CUT = 3.0
"""Sigmas at which Gaussian windows end."""
SMALLEST = 16
"""Pixels across the coarsest image at least."""
HOLD_FLOW, HOLD_SLOPES = 3e-5, 3e-4
"""How firmly the flow stays what it was, and its derivatives 0, relative to the mean texture: it is found where a
thousandth of the usual texture is left, and taken from coarser images where there is none."""


@dataclass(frozen=True)
class Following:
    """How flow is fitted. ``components``: 2, or 1 for motion along x alone; ``affine``: in a window, else constant;
    ``weights``: of the window along each axis, symmetric, sum 1; ``steps`` at full resolution.

    Of coarser images, ``levels`` (None: as many as the image allows), each with ``coarse_steps`` and constant flow in a
    Gaussian of ``coarse_sigma`` px, or with the ``same_window``. ``median``: of 3 x 3 pixels before each step, against
    outliers."""

    components: int
    affine: bool
    weights: tuple[float, ...]
    steps: int = 4
    coarse_steps: int = 3
    coarse_sigma: float = 4.0
    levels: int | None = None
    median: bool = False
    same_window: bool = False

    @property
    def scale(self) -> float:
        """Standard deviation of the window, the unit of offsets in it; 1 for a window of one pixel."""
        offsets = np.arange(len(self.weights)) - len(self.weights) // 2
        return float(np.sqrt(np.dot(self.weights, offsets**2))) or 1.0


def gaussian_window(sigma: float, cut: float = CUT) -> tuple[float, ...]:
    """Weights of a Gaussian that ends at ``cut`` sigmas."""
    return tuple(gaussian_weights(2 * max(1, round(cut * sigma)) + 1, sigma).tolist())


def follow(
    device: Device, images: Array, levers: Array, how: Following, errors: bool = False, initial: Array | None = None
) -> tuple[Array, Array | None]:
    """Flow [components, y, x] in px per lever of ``images`` [k, y, x] with ``levers`` [k], and its standard error.

    ``initial``: flow [components, y, x] to begin with; 0 without.
    """
    pyramid = [np.asarray(images, device.real("storage"))]
    for _ in range(_levels(how, *images.shape[1:])):
        pyramid.append(halved(pyramid[-1]))
    flow = np.zeros((how.components, *pyramid[-1].shape[1:]), pyramid[0].dtype)
    if initial is not None:
        apart = 2 ** (len(pyramid) - 1)
        flow = np.asarray(initial[:, ::apart, ::apart] / apart, pyramid[0].dtype)
    coarse = replace(how, steps=how.coarse_steps, median=how.median)
    if not how.same_window:
        coarse = replace(coarse, affine=False, weights=gaussian_window(how.coarse_sigma))
    std: Array | None = None
    while pyramid:
        last = len(pyramid) == 1
        level = Level(device, pyramid.pop(), levers, how if last else coarse)
        flow = resized(flow, level.shape) if flow.shape[1:] != level.shape else flow
        flow, std = level.solve(flow, errors and last)
    return flow, std


def _levels(how: Following, rows: int, cols: int) -> int:
    """Of the coarser images, 4 pixels across at least."""
    if how.levels is not None:
        return min(how.levels, max(0, int(np.log2(min(rows, cols) / 4))))
    return max(0, int(np.log2(min(rows, cols) / SMALLEST)))


def halved(images: Array) -> Array:
    """Every second pixel of smoothed images [k, y, x]: pixel i of the result is pixel 2 i."""
    for axis in (1, 2):
        n = images.shape[axis]
        padded = np.pad(images, [(2, 2) if a == axis else (0, 0) for a in range(3)], "reflect" if n > 2 else "edge")

        def part(k: int, padded: Array = padded, axis: int = axis, n: int = n) -> Array:
            index = [slice(None)] * 3
            index[axis] = slice(k, k + n, 2)
            return np.asarray(padded[tuple(index)])

        images = (part(0) + part(4)) * 0.0625 + (part(1) + part(3)) * 0.25 + part(2) * 0.375
    return images


def resized(flow: Array, shape: tuple[int, int]) -> Array:
    """Flow [c, y, x] of ``halved`` images, at twice their resolution, interpolated between its pixels."""
    for axis, n in ((1, shape[0]), (2, shape[1])):
        at = np.minimum(np.arange(n) / 2, flow.shape[axis] - 1)
        low = at.astype(int)
        high = np.minimum(low + 1, flow.shape[axis] - 1)
        share = (at - low).astype(flow.dtype).reshape([-1 if a == axis else 1 for a in range(3)])
        flow = np.take(flow, low, axis) * (1 - share) + np.take(flow, high, axis) * share
    return np.asarray(flow * flow.dtype.type(2))


class Level:
    """All that one resolution needs: spline coefficients, tables, and arrays of the device."""

    def __init__(self, device: Device, images: Array, levers: Array, how: Following):
        self.device, self.how, self.n_images = device, how, len(images)
        self.shape = (images.shape[1], images.shape[2])
        self.rows, self.cols = self.shape
        self.radius = len(how.weights) // 2
        self.pitch = round_up(self.cols, LANES)
        self._wide = self.pitch + round_up(2 * self.radius, LANES)
        self.levers = device.array(levers)
        self._coefficients(images)
        self._tables()

    def _coefficients(self, images: Array) -> None:
        """Cubic spline coefficients with a margin, continued by reflection."""
        taps = filter_taps(3, 0.0)
        radius = len(taps) // 2
        rows, cols = self.rows + 2 * MARGIN, self.cols + 2 * MARGIN
        self._image_wide = round_up(cols, LANES)
        along_y = radius if self.how.components == 2 else 0
        across = round_up(self._image_wide + 2 * radius, LANES)
        around = MARGIN + radius
        tall = self.rows + 2 * (MARGIN + along_y)
        padded = np.zeros((self.n_images, tall, across), images.dtype)
        y = reflected(self.rows, MARGIN + along_y)
        x = reflected(self.cols, around)
        padded[:, :, : len(x)] = images[:, y[:, None], x]
        source = self.device.array(padded)
        del padded
        if along_y:
            outputs = [[((k * tall + r) * across, float(w)) for r, w in enumerate(taps)] for k in range(self.n_images)]
            filtering = Filtering(self.device, outputs, rows, across, across)
            result = self.device.empty(filtering.size + 2 * radius + LANES)
            filtering(source, result)
            source = result
        outputs = [[(k * rows * across + r, float(w)) for r, w in enumerate(taps)] for k in range(self.n_images)]
        filtering = Filtering(self.device, outputs, rows, self._image_wide, across)
        self.image = self.device.empty(filtering.size)
        filtering(source, self.image)

    def _tables(self) -> None:
        """Which product and which moment each entry of the equations is, and the two passes of the windows."""
        how, device = self.how, self.device
        terms = [(0, 0), (1, 0), (0, 1)] if how.affine else [(0, 0)]
        unknowns = list(product(range(how.components), terms))
        n_square = how.components * (how.components + 1) // 2
        self.n_products = n_square + how.components + 2
        wanted: dict[tuple[int, int, int], int] = {}  # (product, power of x, power of y) -> plane

        def plane(product_: int, powers: tuple[int, int]) -> int:
            return wanted.setdefault((product_, *powers), len(wanted))

        lower = []
        for r, (c, (px, py)) in enumerate(unknowns):
            for d, (qx, qy) in unknowns[: r + 1]:
                lower.append(plane(max(c, d) * (max(c, d) + 1) // 2 + min(c, d), (px + qx, py + qy)))
        right = [plane(n_square + c, powers) for c, powers in unknowns]
        self.squares = plane(n_square + how.components, (0, 0))
        plane(n_square + how.components + 1, (0, 0))
        self.n_unknowns, self.n_terms, self.n_moments = len(unknowns), len(terms), len(wanted)
        self.lower, self.right = device.array(lower, "int"), device.array(right, "int")
        self.power = device.array([2.0 ** (-0.5 * sum(powers)) for _, powers in unknowns])
        offsets = (np.arange(2 * self.radius + 1) - self.radius) / how.scale
        kernels = [(np.array(how.weights) * offsets**m).tolist() for m in range(3)]
        columns = list(dict.fromkeys((p, py) for p, _, py in wanted))
        tall = self.rows + 2 * self.radius
        self._along_y = Filtering(
            device,
            [[((p * tall + r) * self._wide, w) for r, w in enumerate(kernels[py])] for p, py in columns],
            self.rows, self._wide, self._wide,
        )  # fmt: skip
        self._along_x = Filtering(
            device,
            [
                [(columns.index((p, py)) * self.rows * self._wide + r, w) for r, w in enumerate(kernels[px])]
                for p, px, py in wanted
            ],
            self.rows, self.pitch, self._wide,
        )  # fmt: skip

    def solve(self, flow: Array, errors: bool) -> tuple[Array, Array | None]:
        """The flow [c, y, x] after all steps, and with ``errors`` its standard error."""
        from leafflow_ti.kernels.spec import KernelSpec
        from leafflow_ti.kernels.warp import flow_products_kernel, flow_solve_kernel, follow_kernel

        device, c = self.device, self.how.components
        spec = KernelSpec(device.storage, device.storage, device.dense.lanes, device.gpu)
        size = self.rows * self.pitch
        groups = size // spec.lanes
        start = np.zeros((c, self.rows, self.pitch), device.real("storage"))
        start[:, :, : self.cols] = flow
        moving = device.array(start)
        planes = device.zeros(5 * size)
        products = device.zeros(self.n_products * (self.rows + 2 * self.radius) * self._wide)
        tall = device.empty(self._along_y.size + 2 * self.radius + LANES)
        moments = device.empty(self._along_x.size)
        std = device.zeros(c * size if errors else spec.lanes)
        tasks, solving = device.tasks(self.rows), device.tasks(groups)
        n = self.n_unknowns
        workspace = device.empty((groups if device.gpu else solving) * (n * (n + 1) + n * (1 + c)) * spec.lanes)

        def vectors(array: Any) -> Any:
            return device.vectors(array, spec.lanes)

        damping = None
        for step in range(self.how.steps):
            last = errors and step == self.how.steps - 1
            if self.how.median:
                start[:, :, : self.cols] = median_of_nine(self._maps(moving))
                device.write(moving, 0, start)
            follow_kernel(device.planes, c)(
                self.n_images, self.rows, self.cols, self.pitch, self._image_wide, tasks, self.levers, self.image,
                moving, planes,
            )  # fmt: skip
            flow_products_kernel(device.planes, c)(
                self.rows, self.cols, self.pitch, self.radius, self._wide, tasks, planes, moving, products
            )
            if damping is None:
                damping = self._damping(planes)
            self._along_y(products, tall)
            self._along_x(tall, moments)
            share = float(np.square(self.how.weights).sum()) ** 2
            flow_solve_kernel(spec)(
                n, c, int(last), groups, self.squares, share, solving, self.lower, self.right, self.power, damping,
                vectors(moments), vectors(workspace), vectors(moving), vectors(std),
            )  # fmt: skip
        found = self._maps(moving)
        return found, self._maps(std) if errors else None

    def _maps(self, array: Any) -> Array:
        values = self.device.host(array).reshape(self.how.components, self.rows, self.pitch)
        return np.array(values[:, :, : self.cols])

    def _damping(self, planes: Any) -> Any:
        """Diagonal that holds what texture does not tell, from the mean of the squared gradient."""
        host = self.device.host(planes).reshape(5, self.rows, self.pitch)[:, :, : self.cols]
        texture, weight = host[TEXTURE], host[LEVER]
        along_x = np.diff(texture, axis=1)
        mean = float(np.mean(np.square(along_x, dtype=np.float64))) * float(weight.mean(dtype=np.float64))
        if self.how.components == 2:
            mean += float(np.mean(np.square(np.diff(texture, axis=0), dtype=np.float64))) * float(weight.mean())
        mean = max(mean, 1e-20)
        hold = [HOLD_FLOW, *[HOLD_SLOPES] * (self.n_terms - 1)] * self.how.components
        return self.device.array(np.array(hold) * mean)


def median_of_nine(maps: Array) -> Array:
    """Median over 3 x 3 pixels of maps [n, y, x], reflected at the border."""
    rows, cols = maps.shape[1:]
    padded = maps[:, reflected(rows, 1)[:, None], reflected(cols, 1)]
    shifted = [padded[:, dy : dy + rows, dx : dx + cols] for dy in range(3) for dx in range(3)]
    return np.asarray(np.median(shifted, axis=0), maps.dtype)


def reflected(n: int, margin: int) -> NDArray[np.int64]:
    """Indices of ``n`` pixels with ``margin`` more on each side, reflected at the outermost ones as often as needed."""
    period = max(1, 2 * (n - 1))
    at = np.abs(np.arange(-margin, n + margin)) % period
    return np.minimum(at, period - at) if n > 1 else np.zeros(n + 2 * margin, np.int64)
