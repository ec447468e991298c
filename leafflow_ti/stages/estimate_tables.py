"""The tables that describe a problem to the per-pixel stages: one pair per data vector (see ``kernels.workspace``)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.models import AXES, ColumnSet, TensorLayout
from leafflow_ti.runtime import Device
from leafflow_ti.sampling import (
    NoiseTerm,
    Sampling,
    column_noise,
    cross_noise,
    difference_variance,
    noise_ratio,
    shared_noise,
    white_smoothness,
)
from leafflow_ti.stages.cells import Cells, SourcePlanes
from leafflow_ti.stages.estimators import ESTIMATORS
from leafflow_ti.stages.mask_moments import CutTables
from leafflow_ti.stages.problem import BRIGHTNESS_MAPS, OwnFlows, Problem
from leafflow_ti.stages.thresholds import (
    DENOISE,
    GAP,
    GUARDED,
    LEAST_NOISE,
    LEAST_PX,
    LEAST_SHARE,
    MAX_CONTRADICTION,
    MAX_RESIDUAL_PX,
    MIN_MASS,
    MIN_STRUCTURE,
    MISFIT_PX,
    MODEL_ERROR,
    MOST_NOISE,
    MOST_PX,
    PENALTIES,
    RELAXATION,
    RIDGE,
    SCALE_SHRINK,
    SCALE_START,
    STEP_SIZE,
    TURNING_ERROR,
)
from leafflow_ti.stages.view import View
from leafflow_ti.stages.windows import taps


def _solution_noise(
    sampling: Sampling, columns: ColumnSet, scale: NDArray[np.float64]
) -> tuple[list[NDArray[np.float64]], tuple[NoiseTerm, ...]]:
    """Each solution's noise: ratios (packed), then the values of the terms that centred squares add; and the terms."""
    lower = np.tril_indices(columns.n_flow)
    found = [noise_ratio(sampling, columns, a) for a in columns.solutions]
    values = [np.array([t.value * scale[t.a] * scale[t.b] for t in terms]) for _, terms in found]
    return [*(ratio[lower] for ratio, _ in found), *values], found[0][1]


def _sheared(columns: ColumnSet) -> list[tuple[tuple[int, int], int]]:
    """Columns along time that images shifted by a motion mix with others: (column, other), the other's axis 0 or 1.

    At x' = x - m Δt a field p + p_x Δx + p_y Δy + p_t Δt has the derivative p_t + m · (p_x, p_y) along time.
    """
    pairs = [(columns.index(c, "t"), columns.index(c, o), k) for c in ("x", "y", "i") for k, o in enumerate("xy")]
    return [((t, other), k) for t, other, k in pairs if t is not None and other is not None]


def _packed(a: int, b: int) -> int:
    """Position of an element of a symmetric matrix in its packed lower triangle."""
    r, c = max(a, b), min(a, b)
    return r * (r + 1) // 2 + c


@dataclass
class Tables:
    """The tables of one data vector."""

    number: NDArray[np.int32]
    value: NDArray[np.float64]


class ProblemTables:
    """All tables of a problem, and the layout of the workspace that they speak of.

    ``tables``: of the reference model; with own flows also of its rows among all unknowns (``FINAL``), then (from
    ``OWN`` on) of each camera's own flow; for an estimator in raw units the same once more, without scales, from
    ``raw`` on.
    """

    FINAL, OWN = 1, 2

    def __init__(
        self, device: Device, problem: Problem, layout: TensorLayout, sources: Sequence[SourcePlanes] = ()
    ):  # fmt: skip
        from leafflow_ti.kernels.maps import Output
        from leafflow_ti.kernels.spec import EXTRA_PLANES
        from leafflow_ti.kernels.workspace import Layout

        self.device, self.problem = device, problem
        columns, own = problem.columns, problem.own_flows
        rows = self._rows()
        n_rows = [2 * len(problem.offsets) + problem.use_range] + ([2 * len(own.offsets)] if own else [])
        planes = [len(layout.entries) + EXTRA_PLANES]
        planes += [len(TensorLayout.of(own.columns).entries) + EXTRA_PLANES] * len(own.steps) if own else []
        self._first_plane = np.cumsum([0, *planes]).tolist()
        self._estimator = ESTIMATORS[problem.estimator]
        self._mask = problem.mask_moments(layout)
        self._cells = [Cells(r) for r in problem.requests(layout)[:2]] if self._estimator.weighs else []
        self._sources = sources
        self.layout = Layout(
            columns.n, columns.n_time_like, max(planes), len(rows.camera[0]) if rows.camera else 0,
            max(len(rows.motion), *n_rows), len(problem.terms), max(n_rows),
            max(problem.fitted, problem.unknowns + bool(own and own.growth), 3 if problem.range_scale else 1),
            columns.n_flow if own and own.reference_rows else 0, Output.PLANES,
            max((len(c.sources) for c in self._cells), default=0),
            max((len(c.monomials) for c in self._cells), default=0), self._estimator.biased,
            self._mask.n_planes if self._mask else 0, self._n_shapes,
        )  # fmt: skip
        self.reference = self._with_cells(self._reference_tables(rows, layout), 0)
        self.tables = [self.reference]
        if own:
            final = Tables(self.reference.number.copy(), self.reference.value)
            self._set_numbers(final.number, CORRELATED=columns.n_flow)
            self._set_unknowns(final.number, own.unknowns, own.growth)
            self.tables += [final, *self._own_tables(own)]
        self.raw = len(self.tables)
        if any(move.raw for move in self._estimator.moves(problem.solver, problem.cut)):
            self.tables += [
                Tables(t.number.copy(), self._unscaled(t.value, c))
                for t, c in zip(self.tables, self._owners(), strict=True)
            ]
        self.set_noise(problem.noise)

    def _owners(self) -> list[ColumnSet]:
        """Whose columns each of the tables describes."""
        columns, own = self.problem.columns, self.problem.own_flows
        owners = [columns, columns, *(own.columns for _ in own.steps)] if own else [columns]
        return owners * (len(self.tables) // len(owners))

    def _rows(self) -> SimpleNamespace:
        """Columns of the motion rows and of each camera solution's geometry rows; brightness rows stand last."""
        problem, columns = self.problem, self.problem.columns

        def both(own: str, offsets: Sequence[str], brightness: Sequence[str]) -> list[int]:
            other = "y" if own == "x" else "x"
            found = [columns.index(c, o) for c in (own, other) for o in offsets]
            found += [columns.index("i", o) for o in brightness]
            return [i for i in found if i is not None]

        motion = both("x", problem.offsets, problem.brightness) if "t" in columns.solutions else []
        if problem.range_scale is not None:
            motion.insert(2, 2)  # the column of W, behind those of U' and V'
        camera = [both("x" if a == "sx" else "y", problem.terms, ["1"]) for a in problem.camera_axes]
        return SimpleNamespace(motion=motion, camera=camera)

    @staticmethod
    def _set_numbers(number: NDArray[np.int32], **entries: int) -> None:
        from leafflow_ti.kernels.workspace import Number

        for name, entry in entries.items():
            number[Number[name]] = entry

    @staticmethod
    def _set_unknowns(number: NDArray[np.int32], n: int, growth: bool = False) -> None:
        """The unknowns are the first ``n`` components of (N, Ω, A), and the growth behind them."""
        from leafflow_ti.kernels.patch import GROWTH
        from leafflow_ti.kernels.workspace import Number

        number[Number.UNKNOWNS] = n + growth
        number[Number.PLACE : Number.PLACE + n] = range(n)
        if growth:
            number[Number.PLACE + GROWTH] = n

    def _tables(
        self, columns: ColumnSet, sampling: Sampling, layout: TensorLayout, offsets: Sequence[str], rows: Sequence[int]
    ) -> Tables:
        """What the tables of every data vector hold: columns, noise, the motion rows."""
        from leafflow_ti.kernels.patch import RANGE_CODE
        from leafflow_ti.kernels.workspace import Number, Region, Value

        problem, precision = self.problem, self.device.algebra
        noise, sheared = column_noise(sampling, columns), _sheared(columns)
        ratios, terms = _solution_noise(sampling, columns, noise**-0.5)
        number = np.full(Number.LOWER + len(layout.lower) + 2 * len(terms), -1, np.int32)
        value = np.concatenate([np.zeros(Value.RATIO), *ratios])
        number[: len(Region)] = self.layout.offsets
        self._set_numbers(
            number, N=columns.n, SOLUTIONS=columns.n_time_like, FLOW=columns.n_flow, ITERATIONS=problem.iterations,
            BLOCK=GUARDED[columns.n_time_like], FIRST_PLANE=0,
            MOTION_SOLUTION=columns.n_time_like - 1 if "t" in columns.solutions else -1, TERMS=len(problem.terms),
            OFFSETS=len(offsets), ROWS_T=len(rows), ROWS_S=0, USE_RANGE=0, UNKNOWNS=0, WEIGHTED=problem.weighted,
            BRIGHTNESS_COLUMN=-1, BRIGHTNESS_ROWS=0, WORLD_MAPS=0, RANGE_TERM=-1, CAMERA_SOLUTIONS=0, CROSS_TERMS=0,
            OWN_FLOW=0, CORRELATED=0, EXTRA=len(layout.entries), CENTRE_TERMS=len(columns.at_centre) + len(sheared),
            NOISE_TERMS=len(terms), MOTION_FLOW=len(rows),
        )  # fmt: skip
        for j, (column, other, factor) in enumerate((*columns.at_centre, *((*pair, 0.0) for pair, _ in sheared))):
            number[Number.CENTRE + 2 * j : Number.CENTRE + 2 * j + 2] = column, other
            value[Value.CENTRE + j] = factor
        flow_rows = [i for c in ("x", "y") if (i := columns.index(c)) is not None]
        number[Number.FLOW_ROWS : Number.FLOW_ROWS + 2] = flow_rows
        for i, o in enumerate(offsets):
            number[Number.OFFSET_CODES + i] = 0 if o == "1" else 1 + AXES.index(o)
        number[Number.MOTION_ROWS : Number.MOTION_ROWS + len(rows)] = rows
        lower = Number.LOWER + len(layout.lower)
        number[Number.LOWER : lower] = layout.lower
        number[lower:] = [n for t in terms for n in (_packed(t.a, t.b), layout.lower[_packed(t.base_a, t.base_b)])]
        value[Value.RIDGE], value[Value.GAP], value[Value.STEP_SIZE] = (t[precision] for t in (RIDGE, GAP, STEP_SIZE))
        value[Value.SCALE : Value.SCALE + columns.n] = noise**-0.5
        value[Value.NOISE : Value.NOISE + columns.n] = noise
        value[Value.GAIN] = noise[flow_rows[0]]
        value[Value.MIN_MASS], value[Value.MAX_RESIDUAL] = MIN_MASS, MAX_RESIDUAL_PX
        value[Value.LEAST_SHARE] = LEAST_SHARE
        # Undetermined is what holds no more texture than noise, in J_ff without the share that is taken out.
        value[Value.UNKNOWN] = 2.0 - DENOISE[problem.estimator]
        value[Value.MISFIT] = 2 * MISFIT_PX**2
        value[Value.ROUGHEST] = 1.5 * white_smoothness(sampling)
        value[Value.MIN_STRUCTURE] = MIN_STRUCTURE[self.device.storage]
        for code, name in enumerate(("1", *AXES, "range")):
            value[Value.MODEL_ERROR + code] = MODEL_ERROR[name]
        assert len(AXES) + 1 == RANGE_CODE
        value[Value.TURNING_ERROR] = TURNING_ERROR
        value[Value.SECOND_MOMENT : Value.SECOND_MOMENT + 2] = sampling.x.moment(2), sampling.y.moment(2)
        # Windows that do not overlap from one frame to the next share no content that could be followed.
        value[Value.MAX_SHIFT] = min(sampling.x.size, sampling.y.size)
        value[Value.DENOISE] = DENOISE[problem.estimator]
        return self._with_cut(Tables(number, value), columns, sampling)

    @property
    def _n_shapes(self) -> int:
        """Most shapes of columns of any data vector, where windows may be cut."""
        if not self._mask:
            return 0
        own = self.problem.own_flows
        columns = [self.problem.columns, *([own.columns] if own else [])]
        return max(len(CutTables(c, self.problem.sampling, self._mask).shapes) for c in columns)

    def _with_cut(self, tables: Tables, columns: ColumnSet, sampling: Sampling) -> Tables:
        """The same tables, and what takes the place of the moments of whole windows where they are cut."""
        self._set_numbers(tables.number, MASK_PLANES=0)
        if not self._mask:
            return tables
        cut = CutTables(columns, sampling, self._mask)
        self._set_numbers(
            tables.number, MASK_PLANES=self._mask.n_planes, MASK_PLANE=self._first_plane[-1],
            CURVED_BASIS=3 if self._mask.affine else 1, SHAPES=len(cut.shapes), CUT_NOISES=len(cut.noises),
            CUT_PRODUCTS=len(cut.products), CUT_LISTS=len(tables.number), CUT_VALUES=len(tables.value),
        )  # fmt: skip
        number = np.concatenate([tables.number, np.array(cut.lists, np.int32)])
        return Tables(number, np.concatenate([tables.value, cut.values]))

    def _reference_tables(self, rows: SimpleNamespace, layout: TensorLayout) -> Tables:
        from leafflow_ti.kernels.maps import Output
        from leafflow_ti.kernels.workspace import MAX_ROWS, Number, Value

        problem, columns, sampling = self.problem, self.problem.columns, self.problem.sampling
        tables = self._tables(columns, sampling, layout, problem.offsets, rows.motion)
        number, value = tables.number, tables.value
        brightness = columns.index("i")
        self._set_numbers(
            number, ROWS_S=len(rows.camera[0]) if rows.camera else 0, USE_RANGE=problem.use_range,
            BRIGHTNESS_COLUMN=-1 if brightness is None else brightness,
            BRIGHTNESS_ROWS=len(problem.brightness), MOTION_FLOW=len(rows.motion) - len(problem.brightness),
            WORLD_MAPS=len(problem.world_brightness), CAMERA_SOLUTIONS=len(problem.camera_axes),
            RANGE_TERM=problem.terms.index("t") if "t" in problem.terms else -1,
        )  # fmt: skip
        self._set_unknowns(number, problem.fitted)
        value[Value.MOTION_SCALE : Value.MOTION_SCALE + 2] = problem.range_scale or (0.0, 0.0)
        planes = [Output[BRIGHTNESS_MAPS[o].upper()] - Output.BRIGHTNESS_T for o in problem.brightness]
        number[Number.BRIGHTNESS_PLANES : Number.BRIGHTNESS_PLANES + len(planes)] = planes
        for k, axis in enumerate(problem.camera_axes):
            number[Number.CAMERA_AXIS + k] = 0 if axis == "sx" else 1
            at = Number.CAMERA_ROWS + k * MAX_ROWS
            number[at : at + len(rows.camera[k])] = rows.camera[k]
            terms = cross_noise(sampling, columns, axis, "t") if "t" in columns.solutions else ()
            number[Number.CROSS_TERMS] = len(terms)
            for j, term in enumerate(terms):
                at = Number.CROSS_AB + (k * 9 + j) * 3
                number[at : at + 3] = term.a, term.b, layout.lower[_packed(term.base_a, term.base_b)]
                value[Value.CROSS + k * 9 + j] = term.value
        return tables

    def _own_tables(self, own: OwnFlows) -> list[Tables]:
        """Tables of each camera's own flow: they differ by where the camera stands."""
        from leafflow_ti.kernels.workspace import Number, Value

        columns = self.problem.columns
        rows = [own.columns.index(c, o) for c in ("x", "y") for o in own.offsets]
        common = self._tables(
            own.columns, own.sampling, TensorLayout.of(own.columns), own.offsets, [i for i in rows if i is not None]
        )
        correlated = columns.n_flow if own.reference_rows else 0
        self._set_numbers(common.number, OWN_FLOW=1, CORRELATED=correlated)
        self._set_unknowns(common.number, own.unknowns, own.growth)
        moves = [own.columns.index(c, o) for c in ("x", "y") for o in ("x", "y")]
        common.number[Number.MOVE : Number.MOVE + 4] = [i for i in moves if i is not None]
        found = []
        for camera, (step, first_plane) in enumerate(zip(own.steps, self._first_plane[1:-1], strict=True)):
            one = self._with_cells(Tables(common.number.copy(), common.value), 1 + camera)
            number, value = one.number, one.value.copy()
            number[Number.FIRST_PLANE] = first_plane
            value[Value.CAMERA_STEP : Value.CAMERA_STEP + 2] = own.places[camera] if own.places else step
            for a, (partner, factor) in enumerate(shared_noise(self.problem.sampling, columns, own.columns, step)):
                number[Number.PARTNER + a] = partner
                if partner >= 0:
                    scales = self.reference.value[Value.SCALE + a], value[Value.SCALE + partner]
                    value[Value.PARTNER + a] = factor * scales[0] / scales[1]
            found.append(Tables(number, value))
        return found

    def set_noise(self, noise: float) -> None:
        """Enter the noise level of the images [grey values]."""
        from leafflow_ti.kernels.workspace import Value

        for tables in self.tables:
            tables.value[Value.NOISE_LEVEL] = noise**2

    def aim(self, view: View) -> None:
        """Enter the camera and the output grid."""
        from leafflow_ti.kernels.workspace import Value

        factors = np.sqrt([
            difference_variance(self.problem.sampling.axis(axis), 2 * view.step, int(offset == axis))
            for axis in ("x", "y") for offset in ("1", *AXES, "range")
        ])  # fmt: skip
        for tables, columns in zip(self.tables, self._owners(), strict=True):
            self._set_numbers(tables.number, OUT_X=view.x, OUT_Y=view.y, STEP=view.step, PITCH=view.pitch)
            value = tables.value
            value[Value.F], value[Value.PX], value[Value.PY] = view.f_px, *view.principal_px
            value[Value.BASELINE : Value.BASELINE + 2] = view.baseline_mm
            value[Value.SHIFT : Value.SHIFT + 2] = view.shift_px
            value[Value.MOTION_SHIFT : Value.MOTION_SHIFT + 2] = view.motion_px
            first = Value.CENTRE + len(columns.at_centre)
            for n, (_, axis) in enumerate(_sheared(columns)):
                value[first + n] = -view.motion_px[axis]
            value[Value.DIFFERENCE : Value.DIFFERENCE + 14] = factors

    def _with_cells(self, tables: Tables, request: int) -> Tables:
        """The same tables, and how windows are weighted anew; ``request`` counts in the tensor stage."""
        from leafflow_ti.kernels.workspace import Number, Value

        problem = self.problem
        own = problem.own_flows
        compared = self._estimator.robust and own is not None and own.reference_rows
        self._set_numbers(
            tables.number, REWEIGHTED=len(self._cells) > 0, ROBUST=compared, BIASED=self._estimator.biased
        )
        if not self._cells:
            return tables
        cells, planes = self._cells[min(request, 1)], self._sources[request]
        blocks = cells.request.sampling.x.blocked, cells.request.sampling.y.blocked
        self._set_numbers(
            tables.number, EVERYWHERE=problem.robust == "all", PENALTY=PENALTIES[problem.penalty],
            CELLS_X=taps(blocks[0]), CELLS_Y=taps(blocks[1]), CELL_STEP_X=planes.step_x, CELL_STEP_Y=planes.step_y,
            SOURCES=len(cells.sources), SOURCES_AT=planes.start, SOURCE_PLANE=planes.plane, SOURCE_PITCH=planes.pitch,
            MASS_SOURCE=cells.mass, CELL_MONOMIALS=len(cells.monomials), CELL_NOISES=len(cells.noises),
            CELL_TERMS=sum(map(len, cells.entries)), CELL_LISTS=len(tables.number) + 1, CELL_VALUES=len(tables.value),
        )  # fmt: skip
        number, value = np.concatenate([tables.number, cells.lists]), np.concatenate([tables.value, cells.values])
        columns = cells.request.columns
        constant = [max(c.terms[0].exponents) == 0 for c in columns.columns]
        number[Number.CONSTANT : Number.CONSTANT + columns.n] = constant
        value[Value.SCALE_START], value[Value.SCALE_SHRINK] = SCALE_START, SCALE_SHRINK
        value[Value.LEAST_NOISE], value[Value.LEAST_DISPLACED] = LEAST_NOISE, LEAST_PX**2
        value[Value.MOST_NOISE], value[Value.MOST_DISPLACED] = MOST_NOISE, MOST_PX**2
        value[Value.RELAXATION] = RELAXATION
        value[Value.MAX_CONTRADICTION] = MAX_CONTRADICTION
        return Tables(number.astype(np.int32), value)

    def _unscaled(self, value: NDArray[np.float64], columns: ColumnSet) -> NDArray[np.float64]:
        """The table ``value`` for the tensor in raw units: of pixels, or with coordinates in units of 1 / scale."""
        from leafflow_ti.kernels.workspace import MAX_COLUMNS, Value

        raw = value.copy()
        raw[Value.SCALE : Value.SCALE + MAX_COLUMNS] = 1.0
        degrees = [c.terms[0].exponents[0] + c.terms[0].exponents[1] for c in columns.columns]
        raw[Value.SCALE : Value.SCALE + columns.n] = float(self.problem.scale) ** np.array(degrees)
        return raw
