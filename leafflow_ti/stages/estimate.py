"""Per-pixel stages: structure tensors of a band to named maps, batch by batch."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.models import AXES, ColumnSet, TensorLayout
from leafflow_ti.runtime import Device
from leafflow_ti.sampling import Sampling, column_noise, cross_noise, noise_ratio, white_smoothness
from leafflow_ti.stages.estimators import ESTIMATORS

BATCH_BYTES = 8 << 20
"""Workspace of one batch of pixels: it should stay in the processor's cache."""
RIDGE = {"f64": 1e-13, "f32": 1e-7}
GAP = {"f64": 1e-6, "f32": 1e-3}
DENOISE = {"ols": 0.0, "tls": 0.0, "tls-equilibrated": 0.9}
"""Share of the gradients' own noise that the covariances take out of J_ff; OLS divides by J_ff as it is, and the
residual of raw TLS is no bound for the eigenvalues of the equilibrated tensor.

What noise adds to J_ff is no structure. Taking nearly all of it leaves the matrix definite where there is nothing else,
and makes the standard errors there ten times larger.
"""
RANGE_CAUTION = 3.0
"""Factor of the standard error of b_t in the weights of the motion fit.

The range constraint suffers most from what the affine model leaves out (on a turning 60° face it is off by 2.6 %
without any noise), and ``a_s`` measures the same mixed derivative from the same noise: its own error alone would
overrate it.
"""
STEP_SIZE = {"f64": 1e-4, "f32": 1e-2}
MIN_STRUCTURE = {"f64": 8e-31, "f32": 2e-13}
"""Least energy of the gradient relative to that of the image, (8 eps)²: below, it is the rounding of a constant."""
MIN_MASS = 0.2
"""Least share of the window's weight that must lie inside the images (a corner pixel has 1/4)."""
MAX_RESIDUAL_PX = 0.5
"""Root mean square misfit of the brightness constraint, as a displacement, above which a window is incoherent."""


@dataclass(frozen=True)
class Problem:
    """What is estimated: columns, geometry terms, motion rows; independent of band and device.

    ``offsets`` and ``use_range`` are what ``models.parse_rows`` returned; ``unknowns`` of the motion fit (0: none).
    ``range_scale``: of range flow, mm per px at its working distance.
    """

    columns: ColumnSet
    sampling: Sampling
    estimator: str = "tls-equilibrated"
    solver: str = "fast"
    weighted: bool = True
    offsets: tuple[str, ...] = ("1",)
    use_range: bool = False
    unknowns: int = 0
    passes: int = 3
    iterations: int = 4
    range_scale: float | None = None

    @property
    def terms(self) -> tuple[str, ...]:
        """Geometry terms: the offsets of the disparity that enter the surface fit."""
        if not self.camera_axes:
            return ()
        return tuple(o for o in ("1", "x", "y", "t") if self.columns.index("x", o) is not None)

    @property
    def brightness(self) -> tuple[str, ...]:
        """Offsets of the brightness change in time that are measured."""
        if "t" not in self.columns.solutions:
            return ()
        return tuple(o for o in ("1", "x", "y", "t") if self.columns.index("i", o) is not None)

    @property
    def world_brightness(self) -> tuple[str, ...]:
        """Of these, the ones that geometry (for the slopes) and motion (for the trend) carry into the world (4.28)."""
        if not {"x", "y"} <= {*self.brightness} & {*self.terms}:
            return ()
        return tuple(o for o in self.brightness if o in ("x", "y") or (o == "t" and self.unknowns))

    @property
    def camera_axes(self) -> tuple[str, ...]:
        """Camera axes with a solution."""
        return tuple(a for a in self.columns.solutions if a != "t")


def unknowns_of(motion: str, columns: ColumnSet) -> int:
    """How many of (N, Ω, A) one camera's flow determines.

    Without offsets along x, y the velocity along Z is not seen and taken as zero; nor is, from one camera, the
    acceleration along Z: it enters as ``A_X - x/f A_Z``, ``A_Y - y/f A_Z`` only.
    """
    if columns.index("x", "x") is None:
        return 2
    return {"translation": 3, "rotation": 6, "acceleration": 8}[motion]


BRIGHTNESS_MAPS = {"1": "brightness_t", "x": "brightness_tx", "y": "brightness_ty", "t": "brightness_tt"}
WORLD_MAPS = {"x": "brightness_world_x", "y": "brightness_world_y", "t": "brightness_world_tt"}
"""Offset of the brightness change in time -> name of its map, in the image and on the material."""


def _packed(a: int, b: int) -> int:
    """Position of an element of a symmetric matrix in its packed lower triangle."""
    r, c = max(a, b), min(a, b)
    return r * (r + 1) // 2 + c


@dataclass(frozen=True)
class View:
    """Camera and output grid of one band: pixel (row, col) lies at (x + step col, y + step row)."""

    f_px: float
    principal_px: tuple[float, float]
    baseline_mm: tuple[float, float]
    shift_px: tuple[float, float]
    x: int
    y: int
    step: int
    rows: int
    cols: int
    pitch: int


class EstimateStage:
    """Maps of ``Output`` planes [rows, pitch] from the packed tensor of ``TensorStage``."""

    def __init__(self, device: Device, problem: Problem, layout: TensorLayout, view: View):
        from leafflow_ti.kernels.workspace import Layout, Number, Region, Value

        self.device, self.problem, self.view = device, problem, view
        columns = problem.columns
        rows = self._rows()
        self.layout = Layout(
            columns.n, columns.n_time_like, len(rows.camera[0]) if rows.camera else 0, len(rows.motion),
            len(problem.terms), 2 * len(problem.offsets) + problem.use_range,
        )  # fmt: skip
        flow = columns.n_flow
        self._noise = [noise_ratio(problem.sampling, columns, a) for a in columns.solutions]
        terms = len(self._noise[0][1])
        self.numbers = np.full(Number.LOWER + len(layout.lower) + 2 * terms, -1, np.int32)
        self.numbers[: len(Region)] = self.layout.offsets
        self.values = np.zeros(Value.RATIO + columns.n_time_like * (flow * (flow + 1) // 2 + terms))
        self._fill_model(rows, layout)
        self.set_view(view)
        lanes = device.dense.lanes
        n_pixels = view.rows * view.pitch
        itemsize = np.dtype(device.real("algebra")).itemsize
        per_group = self.layout.n_elements * lanes * itemsize
        self._groups = max(1, min(n_pixels // lanes, BATCH_BYTES // per_group if not device.gpu else 1 << 15))
        self._batch_groups = 0
        self._workspace = device.empty(self._groups * self.layout.n_elements * lanes, "algebra")
        from leafflow_ti.kernels.maps import Output

        self._maps = device.empty(Output.PLANES * n_pixels)

    def _rows(self) -> SimpleNamespace:
        """Columns of the motion rows and of each camera solution's geometry rows; brightness rows stand last."""
        problem, columns = self.problem, self.problem.columns

        def both(own: str, offsets: Sequence[str], brightness: Sequence[str]) -> list[int]:
            other = "y" if own == "x" else "x"
            found = [columns.index(c, o) for c in (own, other) for o in offsets]
            found += [columns.index("i", o) for o in brightness]
            return [i for i in found if i is not None]

        if problem.range_scale is not None:
            light = [columns.index("i", o) for o in problem.brightness]
            return SimpleNamespace(motion=[0, 1, 2, *(i for i in light if i is not None)], camera=[])
        motion = both("x", problem.offsets, problem.brightness) if "t" in columns.solutions else []
        camera = [both("x" if a == "sx" else "y", problem.terms, ["1"]) for a in problem.camera_axes]
        return SimpleNamespace(motion=motion, camera=camera)

    def _fill_model(self, rows: SimpleNamespace, layout: TensorLayout) -> None:
        from leafflow_ti.kernels.maps import Output
        from leafflow_ti.kernels.workspace import MAX_ROWS, Number, Value

        problem, columns, sampling = self.problem, self.problem.columns, self.problem.sampling
        number, value = self.numbers, self.values
        precision = self.device.algebra
        number[Number.N], number[Number.SOLUTIONS], number[Number.FLOW] = columns.n, columns.n_time_like, columns.n_flow
        number[Number.ITERATIONS] = problem.iterations
        has_time = "t" in columns.solutions
        number[Number.MOTION_SOLUTION] = columns.n_time_like - 1 if has_time else -1
        number[Number.TERMS] = len(problem.terms)
        number[Number.OFFSETS] = len(problem.offsets)
        number[Number.ROWS_T] = len(rows.motion)
        number[Number.MOTION_FLOW] = len(rows.motion) - len(problem.brightness)
        number[Number.ROWS_S] = len(rows.camera[0]) if rows.camera else 0
        number[Number.USE_RANGE] = problem.use_range
        number[Number.UNKNOWNS] = problem.unknowns
        number[Number.WEIGHTED] = problem.weighted
        number[Number.PASSES] = problem.passes
        brightness = columns.index("i")
        number[Number.BRIGHTNESS_COLUMN] = -1 if brightness is None else brightness
        number[Number.BRIGHTNESS_ROWS] = len(problem.brightness)
        planes = [Output[BRIGHTNESS_MAPS[o].upper()] - Output.BRIGHTNESS_T for o in problem.brightness]
        number[Number.BRIGHTNESS_PLANES : Number.BRIGHTNESS_PLANES + len(planes)] = planes
        number[Number.WORLD_ROW] = 2 * len(problem.offsets) + 1
        number[Number.WORLD_MAPS] = len(problem.world_brightness)
        number[Number.CENTRE_TERMS] = len(columns.at_centre)
        for j, (constant, square, factor) in enumerate(columns.at_centre):
            number[Number.CENTRE + 2 * j : Number.CENTRE + 2 * j + 2] = constant, square
            value[Value.CENTRE + j] = factor
        number[Number.RANGE_TERM] = problem.terms.index("t") if "t" in problem.terms else -1
        number[Number.CAMERA_SOLUTIONS] = len(problem.camera_axes)
        number[Number.EXTRA] = len(layout.entries)
        flow_rows = [i for c in ("x", "y") if (i := columns.index(c)) is not None]
        number[Number.FLOW_ROWS : Number.FLOW_ROWS + 2] = flow_rows
        noise = column_noise(sampling, columns)
        for i, o in enumerate(problem.offsets):
            number[Number.OFFSET_CODES + i] = 0 if o == "1" else 1 + AXES.index(o)
        number[Number.MOTION_ROWS : Number.MOTION_ROWS + len(rows.motion)] = rows.motion
        number[Number.LOWER : Number.LOWER + len(layout.lower)] = layout.lower
        value[Value.RIDGE], value[Value.GAP], value[Value.STEP_SIZE] = (t[precision] for t in (RIDGE, GAP, STEP_SIZE))
        value[Value.SCALE : Value.SCALE + columns.n] = noise**-0.5
        value[Value.NOISE : Value.NOISE + columns.n] = noise
        value[Value.GAIN] = noise[flow_rows[0]]
        value[Value.MOTION_SCALE] = problem.range_scale or 0.0
        value[Value.MIN_MASS], value[Value.MAX_RESIDUAL] = MIN_MASS, MAX_RESIDUAL_PX
        value[Value.ROUGHEST] = 1.5 * white_smoothness(sampling)
        value[Value.MIN_STRUCTURE] = MIN_STRUCTURE[self.device.storage]
        value[Value.RANGE_CAUTION] = RANGE_CAUTION
        # Windows that do not overlap from one frame to the next share no content that could be followed.
        value[Value.MAX_SHIFT] = min(sampling.x.size, sampling.y.size)
        value[Value.DENOISE] = DENOISE[problem.estimator]
        self._fill_noise(layout, noise**-0.5)
        number[Number.CROSS_TERMS] = 0
        for k, axis in enumerate(problem.camera_axes):
            number[Number.CAMERA_AXIS + k] = 0 if axis == "sx" else 1
            at = Number.CAMERA_ROWS + k * MAX_ROWS
            number[at : at + len(rows.camera[k])] = rows.camera[k]
            terms = cross_noise(sampling, columns, axis, "t") if has_time else ()
            number[Number.CROSS_TERMS] = len(terms)
            for j, term in enumerate(terms):
                at = Number.CROSS_AB + (k * 9 + j) * 3
                number[at : at + 3] = term.a, term.b, layout.lower[_packed(term.base_a, term.base_b)]
                value[Value.CROSS + k * 9 + j] = term.value

    def _fill_noise(self, layout: TensorLayout, scale: NDArray[np.float64]) -> None:
        """Tables of each solution's noise: ratios, then the terms that centred squares add to them."""
        from leafflow_ti.kernels.workspace import Number, Value

        lower = np.tril_indices(self.problem.columns.n_flow)
        ratios = [ratio[lower] for ratio, _ in self._noise]
        terms = [[t.value * scale[t.a] * scale[t.b] for t in extra] for _, extra in self._noise]
        self.values[Value.RATIO :] = np.concatenate([*ratios, *terms])
        self.numbers[Number.NOISE_TERMS] = len(terms[0])
        at = Number.LOWER + len(layout.lower)
        self.numbers[at:] = [
            n for t in self._noise[0][1] for n in (_packed(t.a, t.b), layout.lower[_packed(t.base_a, t.base_b)])
        ]

    def set_view(self, view: View) -> None:
        """Move to another band of the same size."""
        from leafflow_ti.kernels.workspace import Number, Value

        self.view = view
        self.numbers[Number.OUT_X], self.numbers[Number.OUT_Y] = view.x, view.y
        self.numbers[Number.STEP], self.numbers[Number.PITCH] = view.step, view.pitch
        self.values[Value.F], self.values[Value.PX], self.values[Value.PY] = view.f_px, *view.principal_px
        self.values[Value.BASELINE : Value.BASELINE + 2] = view.baseline_mm
        self.values[Value.SHIFT : Value.SHIFT + 2] = view.shift_px
        self._number = self.device.array(self.numbers, "int")
        self._value = self.device.array(self.values, "algebra")

    def unscaled(self) -> Any:
        """The table ``value`` with unit scales: the tensor in raw units."""
        from leafflow_ti.kernels.workspace import MAX_COLUMNS, Value

        raw = self.values.copy()
        raw[Value.SCALE : Value.SCALE + MAX_COLUMNS] = 1.0
        return self.device.array(raw, "algebra")

    def unsolved(self) -> bool:
        """Whether pixels of the present batch have no null space yet; on a GPU always, a look would cost more."""
        if self.device.gpu:
            return True
        from leafflow_ti.kernels.workspace import Region

        shape = (-1, self.layout.n_elements, self.device.dense.lanes)
        solved = self._workspace.reshape(shape)[: self._batch_groups, self.layout.offsets[Region.CONVERGED]]
        return bool((solved < 0.5).any())

    def __call__(self, tensor: Any) -> NDArray[Any]:
        """The planes of ``Output`` as a NumPy array [planes, rows, cols]."""
        from leafflow_ti.kernels.covariance import covariance_kernels
        from leafflow_ti.kernels.maps import Output, maps_kernel
        from leafflow_ti.kernels.patch_fit import patch_fit_kernel
        from leafflow_ti.kernels.range_motion import range_motion_kernel

        device, view, problem = self.device, self.view, self.problem
        lanes = device.dense.lanes
        n_pixels = view.rows * view.pitch
        solve = ESTIMATORS[problem.estimator](self)
        covariance = covariance_kernels(device.dense)
        for first in range(0, n_pixels // lanes, self._groups):
            groups = min(self._groups, n_pixels // lanes - first)
            step, stride = (self.layout.n_elements * lanes, lanes) if not device.gpu else (1, groups)

            def launch(
                kernel: Any, value: Any = None, *, which: int = 0, at: Any = (first, groups, step, stride)
            ) -> None:
                first, groups, step, stride = at
                kernel(
                    first * lanes, n_pixels, groups, step, stride, which, device.tasks(groups), self._number,
                    self._value if value is None else value, tensor, self._workspace, self._maps,
                )  # fmt: skip

            self._batch_groups = groups
            solve(launch)
            if "t" in problem.columns.solutions:
                launch(covariance.row_covariance, which=problem.columns.n_time_like - 1)
            for camera in range(len(problem.camera_axes)):
                launch(covariance.row_covariance, which=camera)
                launch(covariance.add_camera, which=camera)
            if problem.camera_axes:
                launch(covariance.geometry)
            if problem.range_scale is not None:
                launch(range_motion_kernel(device.dense))
            elif problem.unknowns:
                launch(patch_fit_kernel(device.dense))
            launch(maps_kernel(device.dense))
        planes = device.host(self._maps).reshape(Output.PLANES, view.rows, view.pitch)
        result: NDArray[Any] = planes[:, :, : view.cols]
        return result
