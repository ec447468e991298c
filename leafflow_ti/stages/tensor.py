"""Structure tensors of one band of the image, from raw frames, frame by frame.

``J = Σ w d d^T`` as moments of products (2.17, 2.20). For every new frame the band's images are filtered along t,
sy, sx, y and x, the products of channels are summed over the camera samples, and the result is kept as this frame's
*maps*. A tensor is a weighted sum of the maps of the frames of its window, convolved with moment windows along y
and x. Nothing is computed twice when the window moves on by a frame.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.models import AXES, ColumnSet, TensorLayout
from leafflow_ti.runtime import Device
from leafflow_ti.sampling import Sampling
from leafflow_ti.stages.planes import Filtering, Terms, round_up
from leafflow_ti.trace import span

EXTRA_PLANES = 4
"""Behind the tensor's entries: window mass, energies of the gradient, of it smoothed once more, of the image."""
OUTPUT_PLANES = 61
FACTOR_PLANES = 4
"""Planes that derived channels may be multiplied by."""
_CAMERA = ("sy", "sx")
_PASSES = ("t", "sy", "sx", "y", "x")
_MASS, _ENERGY, _SMOOTH, _LEVEL = ((name, (0, 0)) for name in ("mass", "energy", "smooth", "level"))


@dataclass(frozen=True)
class Band:
    """A block of output pixels: ``rows`` × ``cols`` at distance ``stride``, and the input block that it needs."""

    rows: int
    cols: int
    stride: int
    halo_y: int
    halo_x: int

    @classmethod
    def of(cls, sampling: Sampling, rows: int, cols: int, stride: int) -> Band:
        """The halo holds the window, the filters, and the filters once more for the texture's smoothness."""
        return cls(
            rows,
            cols,
            stride,
            sampling.y.radius + sampling.y.filter_radius,
            sampling.x.radius + sampling.x.filter_radius,
        )

    @property
    def in_rows(self) -> int:
        """Rows of the input block."""
        return (self.rows - 1) * self.stride + 1 + 2 * self.halo_y

    @property
    def in_cols(self) -> int:
        """Columns of the input block."""
        return (self.cols - 1) * self.stride + 1 + 2 * self.halo_x


def band_bytes(columns: ColumnSet, layout: TensorLayout, sampling: Sampling, band: Band, itemsize: int) -> int:
    """Memory of the arrays of one band, from raw frames to output maps."""
    cameras = math.prod(_images(columns, sampling))
    taps = 2 * sampling.t.filter_radius + 1
    channels = len(columns.channels)
    samples = cameras if columns.derived else sampling.sx.size * sampling.sy.size
    s, t = (AXES.index("sx"), AXES.index("sy")), AXES.index("t")
    maps = {(m.channels, m.exponents[s[0]], m.exponents[s[1]]) for m in layout.moments}
    sums = {(m.channels, m.exponents[s[0]], m.exponents[s[1]], m.exponents[t]) for m in layout.moments}
    tall = {(m.channels, m.exponents[1:]) for m in layout.moments}
    extra = EXTRA_PLANES
    scratch = max(2 * cameras, 3 * samples * channels)
    wide = (
        taps * cameras
        + 2 * scratch
        + samples * channels
        + (channels + FACTOR_PLANES if columns.derived else 0)
        + extra
        + sampling.t.size * (len(maps) + extra)
        + len(sums)
        + extra
    )
    pitch, out_pitch = round_up(band.in_cols, 64), round_up(band.cols, 64)
    output = len(layout.entries) + extra + OUTPUT_PLANES
    return itemsize * (
        wide * band.in_rows * pitch + (len(tall) + extra) * band.rows * pitch + output * band.rows * out_pitch
    )


def _images(columns: ColumnSet, sampling: Sampling) -> tuple[int, int]:
    """Images of one frame: rows and columns of cameras, or one row of a stack."""
    if columns.derived:
        return (1, 1 + max(d.image for d in columns.derived.values()))
    return (2 * sampling.sy.radius + 1, 2 * sampling.sx.radius + 1)


def eroded(valid: NDArray[np.bool_], ry: int, rx: int) -> NDArray[np.bool_]:
    """Where all pixels within (ry, rx) are valid; without the outermost ry rows and rx columns."""
    rows, cols = valid.shape[0] - 2 * ry, valid.shape[1] - 2 * rx
    inside = np.ones((rows, cols), bool)
    for dy, dx in product(range(2 * ry + 1), range(2 * rx + 1)):
        inside &= valid[dy : dy + rows, dx : dx + cols]
    return inside


class TensorStage:
    """Turns a stream of frames of one band into structure tensors.

    ``push`` takes one frame's block [n_sy, n_sx, in_rows, in_cols] (preshifted) and its validity; once the window
    is full it returns the packed tensor [n_entries + EXTRA_PLANES, rows, pitch] as a flat device array, valid until
    the next call. For ``derived`` columns the block is a stack of images [1, n_images, ...] with its factor planes.
    """

    def __init__(self, device: Device, columns: ColumnSet, layout: TensorLayout, sampling: Sampling, band: Band):
        self.device, self.band, self.sampling = device, band, sampling
        self.columns = columns
        self.cameras = _images(columns, sampling)
        self.reference = (0, 0) if columns.derived else (self.cameras[0] // 2, self.cameras[1] // 2)
        self.pitch = round_up(band.in_cols, 64)
        self.out_pitch = round_up(band.cols, 64)
        self.n_taps = 2 * sampling.t.filter_radius + 1
        self._slack = band.stride * 64 + self.pitch * (2 * sampling.y.filter_radius + 1) + 256
        self._frame_size = self.cameras[0] * self.cameras[1] * band.in_rows * self.pitch
        self._plan_filters(columns)
        self._plan_products(layout)
        self._plan_windows(layout)
        self._raw = device.empty(self.n_taps * self._frame_size + self._slack)
        self.reset()

    def reset(self) -> None:
        """Forget all frames: the next one pushed starts a new window."""
        self._valid: deque[NDArray[np.bool_]] = deque(maxlen=self.n_taps)
        self._reference: deque[NDArray[Any]] = deque(maxlen=self.n_taps)
        self._pushed = 0
        self._n_maps = 0
        self._factors: deque[NDArray[Any]] = deque(maxlen=self.n_taps)

    @property
    def latency(self) -> int:
        """Frames between the newest one pushed and the one that the tensor belongs to."""
        return self.sampling.t.radius

    def _plan_filters(self, columns: ColumnSet) -> None:
        """Passes along t, sy, sx, y, x; a plane is known by its sample and the axis it was differentiated along."""
        axes = [columns.derived[c].axis if columns.derived else c for c in columns.channels]
        wanted = {None if a == "i" else a for a in axes if a != "1"}
        size = self.band.in_rows * self.pitch
        samples = tuple(product(range(self.n_taps), range(self.cameras[0]), range(self.cameras[1])))
        planes: dict[Any, int] = {(*s, None): i * size for i, s in enumerate(samples)}
        self._passes: list[list[Filtering]] = []
        rows = self.band.in_rows
        for i, axis in enumerate(_PASSES):
            plan = self.sampling.axis(axis)
            if plan.filters is None:
                continue
            if axis == "y":
                rows -= 2 * plan.filter_radius
            differentiated: set[str | None] = {None} if None in wanted or wanted & set(_PASSES[i + 1 :]) else set()
            differentiated |= wanted & set(_PASSES[: i + 1])
            phases = []
            # The frames lie in a ring: which slot is the oldest changes with every frame.
            for oldest in range(self.n_taps if axis == "t" else 1):
                moved = (
                    {((k[0] - oldest) % self.n_taps, *k[1:]): at for k, at in planes.items()} if axis == "t" else planes
                )
                outputs = self._axis_pass(axis, moved, differentiated)
                phases.append(Filtering(self.device, list(outputs.values()), rows, self.pitch, self.pitch))
            self._passes.append(phases)
            planes = {key: k * rows * self.pitch for k, key in enumerate(outputs)}
        self.map_rows = rows
        self._plane_size = rows * self.pitch
        self._channels = {key: i for i, key in enumerate(planes)}
        largest = max(f.size for phases in self._passes for f in phases)
        self._scratch = [self.device.empty(largest + self._slack) for _ in range(2)]
        self._plan_smoothness()
        self._plan_derived()

    def _axis_pass(self, axis: str, planes: dict[Any, int], differentiated: set[str | None]) -> dict[Any, Any]:
        """Terms of every plane that one pass makes."""
        plan = self.sampling.axis(axis)
        position = {"t": 0, "sy": 1, "sx": 2}.get(axis)
        outputs: dict[Any, list[tuple[int, float]]] = {}
        for key in planes:
            for d in sorted(differentiated & ({key[3]} | ({axis} if key[3] is None else set())), key=str):
                weights = plan.kernel(d == axis)
                if position is None:
                    step = self.pitch if axis == "y" else 1
                    sources = [planes[key] + r * step for r in range(len(weights))]
                else:
                    around = range(key[position] - plan.filter_radius, key[position] + plan.filter_radius + 1)
                    keys = [(*key[:position], c, *key[position + 1 :]) for c in around]
                    if any(k not in planes for k in keys):
                        continue
                    sources = [planes[k] for k in keys]
                outputs[(*key[:3], d)] = [(s, float(w)) for s, w in zip(sources, weights, strict=True) if w]
        return outputs

    def _plan_smoothness(self) -> None:
        """The reference camera's smoothed gradient, a plane of ones, and its grey values lie behind the channels.

        The smoothed planes are displaced by the filter radius: their window sums start that much earlier.
        """
        centre = (self.n_taps // 2, *self.reference)
        self._gradient = [self._channels[(*centre, a)] for a in ("x", "y")]

        def smooth(planes: list[int], axis: str, step: int) -> Filtering:
            weights = self.sampling.axis(axis).kernel(False)
            outputs = [
                [(p * self._plane_size + r * step, float(w)) for r, w in enumerate(weights) if w] for p in planes
            ]
            return Filtering(self.device, outputs, self.map_rows, self.pitch, self.pitch)

        self._smoothing = (smooth(self._gradient, "y", self.pitch), smooth([0, 1], "x", 1))
        n = len(self._channels) + 4 + (len(self.columns.derived) + FACTOR_PLANES if self.columns.derived else 0)
        self._sources = self.device.array(np.ones(n * self._plane_size + self._slack))

    def _plan_derived(self) -> None:
        """Derived channels lie behind all that, then the factor planes: a channel is a product of two planes."""
        n, derived = len(self._channels), self.columns.derived
        if not derived:
            return
        one = n + 2
        self._first_factor = n + 4 + len(derived)
        first, second = [], []
        for d in derived.values():
            where = (self.n_taps // 2, 0, d.image)
            first.append(one if d.axis == "1" else self._channels[(*where, None if d.axis == "i" else d.axis)])
            second.append(one if d.factor is None else self._first_factor + d.factor)
        self._derived = {name: n + 4 + k for k, name in enumerate(derived)}
        self._derived_tables = (
            self.device.array(range(len(derived) + 1), "int"), self.device.array(first, "int"),
            self.device.array(second, "int"), self.device.array(np.ones(len(derived))),
            self.device.array(np.ones(self._plane_size)),
        )  # fmt: skip

    def _plane(self, channel: str, tap: int, sy: int, sx: int) -> int:
        """Plane of a channel of one camera."""
        if self.columns.derived:
            return self._derived[channel]
        return self._channels[tap, sy, sx, None if channel == "i" else channel]

    def _plan_products(self, layout: TensorLayout) -> None:
        """This frame's maps: products summed over camera samples, for each power of the camera offsets."""
        sampling = self.sampling
        centre = self.reference
        outputs: dict[Any, list[tuple[tuple[int, int], float]]] = {}
        tap = self.n_taps // 2
        for moment in layout.moments:
            powers = (moment.exponents[AXES.index("sy")], moment.exponents[AXES.index("sx")])
            key = (moment.channels, powers)
            if key in outputs:
                continue
            weights = [sampling.axis(a).window(p) for a, p in zip(_CAMERA, powers, strict=True)]
            a, b = moment.channels
            terms = []
            for (iy, wy), (ix, wx) in product(enumerate(weights[0]), enumerate(weights[1])):
                where = (tap, centre[0] + iy - len(weights[0]) // 2, centre[1] + ix - len(weights[1]) // 2)
                if wy * wx:
                    terms.append(((self._plane(a, *where), self._plane(b, *where)), float(wy * wx)))
            outputs[key] = terms
        n = len(self._channels)
        outputs[_ENERGY] = [((g, g), 1.0) for g in self._gradient]
        outputs[_SMOOTH] = [((n + k, n + k), 1.0) for k in range(2)]
        outputs[_MASS] = [((n + 2, n + 2), 1.0)]
        outputs[_LEVEL] = [((n + 3, n + 3), 1.0)]
        terms_table = Terms.of(list(outputs.values()))
        self._map_index = {key: i for i, key in enumerate(outputs)}
        self._product_tables = (
            self.device.array(terms_table.first, "int"),
            self.device.array([s[0] for s in terms_table.source], "int"),
            self.device.array([s[1] for s in terms_table.source], "int"),
            self.device.array(terms_table.weight),
        )
        self._slot_size = len(outputs) * self._plane_size
        self._maps = self.device.empty(sampling.t.size * self._slot_size + self._slack)

    def _plan_windows(self, layout: TensorLayout) -> None:
        """Sums over the frames of the window, then moment windows along y, then along x."""
        sampling, band = self.sampling, self.band
        x, y, t = (AXES.index(a) for a in ("x", "y", "t"))
        summed: dict[Any, int] = {}
        tall: dict[Any, int] = {}
        # Of every output plane: the tall planes that it is made of, and the window along x that each is convolved with.
        final: list[dict[int, NDArray[np.float64]]] = []

        def column_sum(key: Any, q: int, n: int) -> int:
            one = summed.setdefault((key, q), len(summed))
            return tall.setdefault((one, n), len(tall))

        for entry in layout.entries:
            windows: dict[int, NDArray[np.float64]] = {}
            for moment, factor in entry:
                e = moment.exponents
                two = column_sum((moment.channels, (e[AXES.index("sy")], e[AXES.index("sx")])), e[t], e[y])
                windows[two] = windows.get(two, np.zeros(1)) + factor * sampling.x.window(e[x])
            final.append(windows)
        final += [{column_sum(extra, 0, 0): sampling.x.window(0)} for extra in (_MASS, _ENERGY, _SMOOTH, _LEVEL)]
        n_t = sampling.t.size
        self._sums = []
        for newest in range(n_t):
            # Slot of the frame at window position i, the newest one (last position) lying in slot ``newest``.
            slots = [(newest + 1 + i) % n_t for i in range(n_t)]
            outputs = [
                [
                    (slots[i] * self._slot_size + self._map_index[key] * self._plane_size, float(w))
                    for i, w in enumerate(sampling.t.window(q))
                    if w
                ]
                for key, q in summed
            ]
            self._sums.append(Filtering(self.device, outputs, self.map_rows, self.pitch, self.pitch))
        lead_y, lead_x = sampling.y.filter_radius, sampling.x.filter_radius
        rows = band.rows
        plain = {i for (key, _), i in summed.items() if key != _SMOOTH}
        self._along_y = Filtering(
            self.device,
            [
                [
                    (one * self._plane_size + (lead_y * (one in plain) + r) * self.pitch, float(w))
                    for r, w in enumerate(sampling.y.window(n))
                    if w
                ]
                for one, n in tall
            ],
            rows, self.pitch, band.stride * self.pitch,
        )  # fmt: skip
        displaced = {two for (one, _), two in tall.items() if one not in plain}
        self._along_x = Filtering(
            self.device,
            [
                [
                    (two * rows * self.pitch + lead_x * (two not in displaced) + r, float(w))
                    for two, window in windows.items()
                    for r, w in enumerate(window)
                    if w
                ]
                for windows in final
            ],
            rows, self.out_pitch, self.pitch, band.stride,
        )  # fmt: skip
        self._summed = self.device.empty(self._sums[0].size + self._slack)
        self._tall = self.device.empty(self._along_y.size + self._slack)
        self.tensor = self.device.empty(self._along_x.size + self._slack)

    def push(self, block: NDArray[Any], valid: NDArray[np.bool_], factors: NDArray[Any] | None = None) -> Any | None:
        """Add the next frame; the tensor of the frame ``latency`` before it, or None while the window fills.

        ``valid`` [in_rows, in_cols]: pixels at which every camera has a finite grey value inside its image;
        ``factors`` [FACTOR_PLANES, in_rows, in_cols]: what derived channels are multiplied by.
        """
        with span("filter"):
            if not self._add_frame(block, valid, factors):
                return None
        with span("tensor"):
            self._sums[(self._n_maps - 1) % self.sampling.t.size](self._maps, self._summed)
            self._along_y(self._summed, self._tall)
            self._along_x(self._tall, self.tensor)
        return self.tensor

    def _add_frame(self, block: NDArray[Any], valid: NDArray[np.bool_], factors: NDArray[Any] | None) -> bool:
        """Filter the next frame into its maps; whether the window is full."""
        frame = np.zeros((*self.cameras, self.band.in_rows, self.pitch), self.device.real("storage"))
        frame[..., : self.band.in_cols] = block
        self.device.write(self._raw, self._pushed % self.n_taps * self._frame_size, frame)
        self._valid.append(valid)
        self._reference.append(frame[self.reference].copy())
        if factors is not None:
            self._factors.append(np.asarray(factors, frame.dtype))
        self._pushed += 1
        if self._pushed < self.n_taps:
            return False
        self._make_maps()
        return self._n_maps >= self.sampling.t.size

    def _make_maps(self) -> None:
        from leafflow_ti.kernels.planes import sum_products_kernel

        device = self.device
        source = self._raw
        for i, phases in enumerate(self._passes):
            target = self._sources if i == len(self._passes) - 1 else self._scratch[i % 2]
            phases[self._pushed % len(phases)](source, target)
            source = target
        along_y, along_x = self._smoothing
        along_y(self._sources, self._scratch[0])
        along_x(self._scratch[0], self._sources, len(self._channels) * self._plane_size)
        grey = self._reference[self.n_taps // 2]
        device.write(self._sources, (len(self._channels) + 3) * self._plane_size, self._inner(grey))
        if self.columns.derived:
            self._make_derived()
        slot = self._n_maps % self.sampling.t.size
        sum_products_kernel(device.planes)(
            len(self._map_index), self._plane_size, slot * self._slot_size,
            device.tasks(self._plane_size // device.planes.lanes),
            *self._product_tables, device.array(self._mask()), self._sources, self._maps,
        )  # fmt: skip
        self._n_maps += 1

    def _make_derived(self) -> None:
        from leafflow_ti.kernels.planes import sum_products_kernel

        device, size, n = self.device, self._plane_size, len(self._derived)
        for k, plane in enumerate(self._factors[self.n_taps // 2]):
            padded = np.pad(plane, ((0, 0), (0, self.pitch - plane.shape[1])))
            device.write(self._sources, (self._first_factor + k) * size, self._inner(padded))
        sum_products_kernel(device.planes)(
            n, size, (self._first_factor - n) * size, device.tasks(size // device.planes.lanes),
            *self._derived_tables, self._sources, self._sources,
        )  # fmt: skip

    def _inner(self, image: NDArray[Any]) -> NDArray[Any]:
        """A plane of the block [in_rows, pitch] where the channels are: [map_rows, pitch]."""
        ry, rx = self.sampling.y.filter_radius, self.sampling.x.filter_radius
        return np.pad(image[ry : ry + self.map_rows, rx:], ((0, 0), (0, rx)))

    def _mask(self) -> NDArray[Any]:
        """Where the filters see valid pixels only: [map_rows, pitch]."""
        valid = np.logical_and.reduce(list(self._valid))
        ry, rx = self.sampling.y.filter_radius, self.sampling.x.filter_radius
        mask = np.zeros((self.map_rows, self.pitch), self.device.real("storage"))
        mask[:, : self.band.in_cols - 2 * rx] = eroded(valid, ry, rx)
        return mask
