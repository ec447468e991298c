"""The whole estimate put together from NumPy and SciPy, timed for comparison.

As someone would write it who knows both well: float64, every step vectorised. ``correlate1d`` for filters and windows,
``tensordot`` for the sums over cameras and frames, ``numpy.linalg.eigh`` for the null space, batched linear algebra for
error bars and the 3D fit (``scipy_fit``). Tables (columns, filter taps, noise ratios) come from the library, the
numerical work does not. It delivers depth, slopes, flow and motion with their standard errors; growth and the status
are left out.

Results that later steps leave out are dropped as early as possible: borders after every filter, rows and columns
between the output pixels as soon as the window along that axis has been applied.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray
from scipy.ndimage import correlate1d  # type: ignore[import-untyped]

from leafflow_ti.models import AXES, ColumnSet, Moment
from leafflow_ti.plan import Plan
from leafflow_ti.sampling import AxisSampling, Sampling, column_noise
from perf.scipy_fit import Maps, Patch, fit

Array = NDArray[np.float64]
PLACE = {"t": 0, "sy": 1, "sx": 2, "y": 3, "x": 4}
CHUNK = 4096
"""Pixels whose small matrices are worked on together: they should stay in the processor's cache."""


@dataclass
class Clock:
    """Seconds per stage: ``filter``, ``tensor``, ``null space``, ``errors and fit``."""

    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def of(self, stage: str) -> Iterator[None]:
        """Add the time of a block to one stage."""
        began = time.perf_counter()
        yield
        self.seconds[stage] = self.seconds.get(stage, 0.0) + time.perf_counter() - began

    @property
    def stages(self) -> float:
        """The three stages that every implementation here has: filters, windows, null space."""
        return sum(self.seconds[stage] for stage in ("filter", "tensor", "null space"))

    @property
    def total(self) -> float:
        """The whole job."""
        return sum(self.seconds.values())


@dataclass(frozen=True)
class Tensors:
    """Packed structure tensors [entries, rows, cols] and the texture's smoothness ρ [rows, cols]."""

    packed: Array
    smoothness: Array


Windowing = Callable[[Array, Array, int, int], Array]
"""(image [rows, cols], weights, axis, stride) -> window sums wherever the window fits, every ``stride``-th one."""


def by_correlation(image: Array, weights: Array, axis: int, stride: int) -> Array:
    """``correlate1d``, which knows no stride: the rest is thrown away."""
    full = correlate1d(image, weights, axis=axis)
    return np.ascontiguousarray(_inner(full, axis, len(weights) // 2)[_every(axis, stride)])


def by_products(image: Array, weights: Array, axis: int, stride: int) -> Array:
    """Matrix products with a sliding view: less obvious, several times as fast."""
    return np.asarray(sliding_window_view(image, len(weights), axis=axis)[_every(axis, stride)] @ weights)


def _every(axis: int, stride: int) -> tuple[slice, ...]:
    return (slice(None),) * axis + (slice(None, None, stride),)


def _inner(image: Array, axis: int, radius: int) -> Array:
    """Without the outermost ``radius`` elements along one axis."""
    return image[(slice(None),) * axis + (slice(radius, image.shape[axis] - radius),)]


def estimate(images: NDArray[Any], plan: Plan, clock: Clock, windowing: Windowing = by_correlation) -> Maps:
    """Maps [rows, cols] of the plan's output pixels for the middle camera and frame.

    ``images`` [t, sy, sx, y, x]: all that filters and windows of the output pixels reach (``needed``).
    """
    columns, sampling = plan.problem.columns, plan.problem.sampling
    with clock.of("filter"):
        channels = derivatives(images, columns, sampling)
        maps = products(channels, plan, sampling)
        energies = texture(channels, sampling)
    with clock.of("tensor"):
        tensors = windows(maps, energies, plan, windowing)
    rows, cols = tensors.smoothness.shape
    packed, rho = tensors.packed.reshape(-1, rows * cols), tensors.smoothness.ravel()
    found: list[Maps] = []
    for first in range(0, rows * cols, CHUNK):
        some = slice(first, min(first + CHUNK, rows * cols))
        with clock.of("null space"):
            tensor = unpacked(packed[:, some], columns, plan.layout.lower)
            parameters = null_space(tensor, columns, sampling)
        with clock.of("errors and fit"):
            found.append(fit(tensor, parameters, rho[some], plan.problem, Patch.of(plan, some)))
    return {name: np.concatenate([one[name] for one in found]).reshape(rows, cols) for name in found[0]}


def needed(plan: Plan) -> tuple[int, int, int, int]:
    """The pixels (y0, y1, x0, x1) of the reference image that the output pixels reach."""
    sampling = plan.problem.sampling
    halo = [axis.radius + axis.filter_radius for axis in (sampling.y, sampling.x)]
    return (
        plan.y[0] - halo[0], plan.y[-1] + halo[0] + 1, plan.x[0] - halo[1], plan.x[-1] + halo[1] + 1,
    )  # fmt: skip


def derivatives(images: NDArray[Any], columns: ColumnSet, sampling: Sampling) -> dict[str, Array]:
    """Every channel [t, sy, sx, y, x], without the samples that the filters lack neighbours for.

    Channels share the passes up to the axis along which they are differentiated.
    """
    shared: dict[str, Array] = {"": np.asarray(images, np.float64)}
    wanted = set(columns.channels)
    for i, name in enumerate(PLACE):
        axis = sampling.axis(name)
        if not axis.filters:
            continue
        later = wanted & {"i", *list(PLACE)[i + 1 :]}
        passed = {key: _filtered(image, axis, False, name) for key, image in shared.items() if key or later}
        if name in wanted:
            passed[name] = _filtered(shared[""], axis, True, name)
        shared = passed
    return {("i" if key == "" else key): image for key, image in shared.items()}


def _filtered(image: Array, axis: AxisSampling, differentiate: bool, name: str) -> Array:
    out = correlate1d(image, axis.kernel(differentiate), axis=PLACE[name])
    return np.ascontiguousarray(_inner(out, PLACE[name], axis.filter_radius))


def _key(moment: Moment) -> tuple[tuple[str, str], tuple[int, ...]]:
    """A product image summed over cameras and frames: its channels and the powers of t, sy, sx."""
    return moment.channels, tuple(moment.exponents[AXES.index(a)] for a in ("t", "sy", "sx"))


def products(channels: dict[str, Array], plan: Plan, sampling: Sampling) -> dict[Any, Array]:
    """Product images [y, x], summed over cameras and frames with every power of their offsets."""
    maps: dict[Any, Array] = {}
    ry, rx = sampling.y.filter_radius, sampling.x.filter_radius
    for pair in {moment.channels for moment in plan.layout.moments}:
        product = _inner(_inner(channels[pair[0]] * channels[pair[1]], PLACE["y"], ry), PLACE["x"], rx)
        for moment in plan.layout.moments:
            key = _key(moment)
            if moment.channels == pair and key not in maps:
                weight = np.ones(())
                for axis, power in zip(("t", "sy", "sx"), key[1], strict=True):
                    weight = np.multiply.outer(weight, sampling.axis(axis).window(power))
                maps[key] = np.tensordot(weight, product, axes=3)
    return maps


def texture(channels: dict[str, Array], sampling: Sampling) -> tuple[Array, Array]:
    """Energy [y, x] of the reference camera's gradient, summed over frames; and of it smoothed once more."""
    middle = (slice(None), *(channels["x"].shape[PLACE[a]] // 2 for a in ("sy", "sx")))
    energy, smooth = np.zeros(()), np.zeros(())
    for name in ("x", "y"):
        gradient = channels[name][middle]
        again = correlate1d(gradient, sampling.y.kernel(False), axis=1)
        again = correlate1d(again, sampling.x.kernel(False), axis=2)
        energy = energy + np.tensordot(sampling.t.window(0), gradient**2, axes=1)
        smooth = smooth + np.tensordot(sampling.t.window(0), again**2, axes=1)
    ry, rx = sampling.y.filter_radius, sampling.x.filter_radius
    return _inner(_inner(energy, 0, ry), 1, rx), _inner(_inner(smooth, 0, ry), 1, rx)


def windows(maps: dict[Any, Array], energies: tuple[Array, Array], plan: Plan, windowing: Windowing) -> Tensors:
    """Moment windows along y, then along x, of everything that an entry of the structure tensor is made of."""
    sampling, stride = plan.problem.sampling, plan.x.step
    y, x = AXES.index("y"), AXES.index("x")
    tall: dict[Any, Array] = {}
    for moment in plan.layout.moments:
        key, n = _key(moment), moment.exponents[y]
        if (key, n) not in tall:
            tall[key, n] = windowing(maps[key], sampling.y.window(n), 0, stride)
    planes = []
    for entry in plan.layout.entries:
        terms = (
            windowing(tall[_key(m), m.exponents[y]], factor * sampling.x.window(m.exponents[x]), 1, stride)
            for m, factor in entry
        )
        planes.append(sum(terms, start=np.zeros(())))
    plain, smooth = (
        windowing(windowing(energy, sampling.y.window(0), 0, stride), sampling.x.window(0), 1, stride)
        for energy in energies
    )
    return Tensors(np.stack(planes), np.minimum(smooth / plain, 1.0))


def unpacked(packed: Array, columns: ColumnSet, lower: tuple[int, ...]) -> Array:
    """Structure tensors [n, N, N] from their distinct entries [entries, n]."""
    rows, cols = np.tril_indices(columns.n)
    tensor = np.empty((packed.shape[1], columns.n, columns.n))
    tensor[:, rows, cols] = tensor[:, cols, rows] = packed[list(lower)].T
    return tensor


def null_space(tensor: Array, columns: ColumnSet, sampling: Sampling) -> Array:
    """Parameters [n, n_flow, k] by equilibrated total least squares, one time-like differential being 1."""
    flow, scale = columns.n_flow, column_noise(sampling, columns) ** -0.5
    vectors = np.linalg.eigh(tensor * np.multiply.outer(scale, scale))[1][..., : columns.n_time_like] * scale[:, None]
    return np.asarray(vectors[:, :flow] @ np.linalg.inv(vectors[:, flow:]))
