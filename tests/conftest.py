"""Small scenes run through the stages, beside the naive twin: built once per model, brightness, grid and precision."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import pytest
from reference import cells, chain
from reference import estimators as weighted
from reference.cut import Cut

from leafflow_ti.field import MOTION_NAMES
from leafflow_ti.filters import filter_set
from leafflow_ti.growth import DIFFERENCES
from leafflow_ti.models import (
    BRIGHTNESS,
    MODELS,
    OWN_FLOW,
    ColumnSet,
    TensorLayout,
    column_set,
    flow_offsets,
    parse_rows,
)
from leafflow_ti.runtime import Device, start
from leafflow_ti.sampling import AxisSampling, Sampling
from leafflow_ti.stages.estimate import EstimateStage, View
from leafflow_ti.stages.estimators import ESTIMATORS
from leafflow_ti.stages.mask_moments import MaskMoments
from leafflow_ti.stages.problem import OwnFlows, Problem, unknowns_of
from leafflow_ti.stages.tensor import EXTRA_PLANES, Band, Request, TensorStage
from leafflow_ti.synthetic.material import BrightnessTerm
from leafflow_ti.synthetic.plane import PlaneScene, render

GRIDS = {"single": (1, 1), "line-x": (1, 7), "line-y": (7, 1), "square": (5, 5)}
"""Camera rows and columns. Seven cameras give three samples of 5 taps, five cameras three samples of 3 taps."""

CASES = [
    (model, brightness, grid)
    for model, row in MODELS.items()
    for brightness in BRIGHTNESS
    for grid in GRIDS
    if (row.cameras == "reference") == (grid == "single")
    if model != "affine-5d" or grid == "square"
    if row.time or brightness != "temporal"
    if not row.own_flows and not row.ranges
]
"""Every tensor with every brightness model and every grid that it exists for."""

OWN_FLOW_CASES = [
    (model, brightness, grid)
    for model, row in MODELS.items()
    if row.own_flows
    for brightness in BRIGHTNESS
    for grid in (("line-x", "line-y", "square") if brightness in ("none", "camera") else ("line-x",))
]
"""The models that fit every camera's own flow, too."""

PRESHIFT = (-8.3, 4.8)
"""Disparity [px/step] that the rendered blocks no longer hold: integer preshift and fractional offset together."""

ROWS, COLS, STRIDE = 3, 5, 2
"""Output pixels: neither a multiple of any number of lanes."""

SCENE = PlaneScene(
    f_px=900.0,
    baseline_mm=(0.7, -0.4),
    n_frames=7,
    centre=(0.3, -0.2, 80.0),
    zx=0.5,
    zy=-0.4,
    velocity=(0.021, -0.014, 0.06),
    omega=(0.002, -0.003, 0.004),
    acceleration=(0.004, 0.003, -0.002),
    wavelengths_mm=(0.6, 0.75),
    alpha=0.4,
    beta=1.0,
    noise=1.0,
)
LIGHT = (
    BrightnessTerm("t", 1, 0.01, 0.002, -0.003),
    BrightnessTerm("t", 2, -0.001),
    BrightnessTerm("sx", 1, 0.004),
    BrightnessTerm("sy", 1, -0.005),
)


def pixel_sampling(taps: str = "5", size: int = 11, sigma: float = 3.2) -> AxisSampling:
    """Filters and window along x and y."""
    return AxisSampling.gaussian(filter_set(taps), size, sigma)


def sampling_of(grid: str, time: bool, pixel: AxisSampling | None = None, cameras: str = "grid") -> Sampling:
    """The sampling of a model with these cameras on a grid of ``GRIDS``."""
    rows, cols = GRIDS[grid]
    small, large = (AxisSampling.gaussian(filter_set(taps), 3, 1.0) for taps in ("3", "5"))
    series = {1: AxisSampling(), 5: small, 7: large}
    along_y = cameras == "grid" or (cameras == "line" and cols == 1)
    along_x = cameras != "reference"
    pixel = pixel or pixel_sampling()
    return Sampling(
        pixel, pixel, series[cols] if along_x else AxisSampling(), series[rows] if along_y else AxisSampling(),
        series[7] if time else AxisSampling(),
    )  # fmt: skip


@functools.cache
def rendered(scene: PlaneScene, grid: str, size: tuple[int, int]) -> np.ndarray:
    """Preshifted blocks [t, sy, sx, y, x] of a scene, float64."""
    n_rows, n_cols = GRIDS[grid]
    scene = replace(scene, n_rows=n_rows, n_cols=n_cols, size=size)
    x, y = scene.principal
    out = np.empty((scene.n_frames, n_rows, n_cols, size[1], size[0]))
    for row in range(n_rows):
        for col in range(n_cols):
            at = (x - PRESHIFT[0] * (col - n_cols // 2), y - PRESHIFT[1] * (row - n_rows // 2))
            out[:, row, col] = render(replace(scene, principal_px=at), cameras=([row], [col]))[:, 0, 0]
    return out


@dataclass(frozen=True, eq=False)
class Estimated:
    """What one ``EstimateStage`` found at every output pixel.

    ``planes`` [planes, rows, cols] of ``Output``, those that the model does not have undefined; ``parameters``
    [rows, cols, k, n_flow] of every solution and the noise ``variance`` [rows, cols, k] of its residual.
    """

    problem: Problem
    planes: np.ndarray
    parameters: np.ndarray
    variance: np.ndarray

    def map(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Values and standard errors [rows, cols] of a named map."""
        from leafflow_ti.kernels.maps import Output

        plane = Output.MOTION + MOTION_NAMES.index(name) if name in MOTION_NAMES else Output[name.upper()]
        return self.planes[plane], self.planes[Output.STD + plane]

    def difference(self, name: str) -> np.ndarray:
        """Values [rows, cols] of one of ``growth.DIFFERENCES``."""
        from leafflow_ti.kernels.maps import Output

        return self.planes[Output.DIFFERENCES + DIFFERENCES.index(name)]

    @property
    def status(self) -> np.ndarray:
        """Codes of ``Status`` [rows, cols]."""
        from leafflow_ti.kernels.maps import Output

        return self.planes[Output.STATUS].astype(int)


@dataclass(frozen=True, eq=False)
class Bench:
    """Images of one block and the stages over it.

    ``images`` [t, sy, sx, y, x] hold what ``sampling`` needs around the output pixels of ``band`` and no more.
    """

    device: Device
    images: np.ndarray
    sampling: Sampling
    columns: ColumnSet
    band: Band
    model: str = ""
    valid: np.ndarray | None = None  # [t, y, x]
    brightness: str = "none"
    brightness_terms: str = "none"
    places: tuple[tuple[float, float], ...] = ()  # of the own flows' cameras, where these are no whole steps

    @cached_property
    def layout(self) -> TensorLayout:
        return TensorLayout.of(self.columns)

    @property
    def _tensor(self) -> tuple[TensorStage, Any]:
        return self._pushed(False)

    @functools.cache  # noqa: B019 - a bench lives as long as the session
    def _pushed(self, weighed: bool) -> tuple[TensorStage, Any]:
        """The tensor stage behind the last frame, and its tensors; ``weighed``: with what windows are weighted by."""
        own: list[Request] = []
        if self.model and MODELS[self.model].own_flows:
            sampling, columns = self.own_columns
            layout = TensorLayout.of(columns)
            own = [Request(columns, layout, sampling, (y, x)) for x, y in self.steps]
        requests = (Request(self.columns, self.layout, self.sampling), *own)
        mask = None if weighed else MaskMoments.of(requests)
        stage = TensorStage(self.device, self.columns, self.layout, self.sampling, self.band, own, weighed, mask)
        valid = np.ones((len(self.images), *self.images.shape[3:]), bool) if self.valid is None else self.valid
        found = [stage.push(block, ok) for block, ok in zip(self.images, valid, strict=True)]
        assert all(tensor is None for tensor in found[:-1])
        return stage, found[-1]

    @cached_property
    def own_columns(self) -> tuple[Sampling, ColumnSet]:
        """Sampling and data vector of one camera's own flow."""
        sampling = Sampling(self.sampling.x, self.sampling.y, t=self.sampling.t)
        return sampling, column_set(OWN_FLOW, self.brightness, (), sampling.sampled, self.brightness_terms)

    @cached_property
    def steps(self) -> tuple[tuple[int, int], ...]:
        """Every camera but the reference of ``affine-scene-flow``, as (x, y) steps from it."""
        rows, cols = self.images.shape[1:3]
        steps = [(i - cols // 2, j - rows // 2) for j in range(rows) for i in range(cols)]
        return tuple(s for s in steps if s != (0, 0) or not MODELS[self.model].reference_rows)

    def own_images(self, x: int, y: int) -> np.ndarray:
        """Images [t, 1, 1, y, x] of the camera at a step from the reference."""
        rows, cols = self.images.shape[1:3]
        return self.images[:, y + rows // 2, x + cols // 2][:, None, None]

    @functools.cache  # noqa: B019 - a bench lives as long as the session
    def own_reference(self, row: int, col: int, weighed: bool) -> list[tuple[Any, float]]:
        """J or, where windows are weighted, the cells of every camera's own flow at one output pixel; and ρ."""
        x, y = self.position(row, col)
        # A block with all that one window needs, around the pixel.
        part = np.s_[
            ..., y - self.band.halo_y : y + self.band.halo_y + 1, x - self.band.halo_x : x + self.band.halo_x + 1
        ]
        at = (self.band.halo_x, self.band.halo_y)
        valid = None if self.valid is None else self.valid[part]
        return [cells.window(self.own_images(*s)[part], *self.own_columns, at, valid, weighed) for s in self.steps]

    @cached_property
    def planes(self) -> np.ndarray:
        """Packed tensor and the planes behind it, float64 [n_entries + EXTRA_PLANES, rows, cols]."""
        stage, tensor = self._tensor
        shape = (-1, self.band.rows, stage.out_pitch)
        n = (len(self.layout.entries) + EXTRA_PLANES) * shape[1] * shape[2]
        return np.array(self.device.host(tensor)[:n], np.float64).reshape(shape)[:, :, : self.band.cols]

    def tensor(self, row: int, col: int) -> np.ndarray:
        """Full structure tensor [N, N] of one output pixel."""
        J = np.zeros((self.columns.n, self.columns.n))
        J[np.tril_indices(self.columns.n)] = self.planes[list(self.layout.lower), row, col]
        return J + np.tril(J, -1).T

    def position(self, row: int, col: int) -> tuple[int, int]:
        """Pixel (x, y) of the block at which an output pixel lies."""
        return self.band.halo_x + self.band.stride * col, self.band.halo_y + self.band.stride * row

    @functools.cache  # noqa: B019 - a bench lives as long as the session
    def reference(self, row: int, col: int, weighed: bool = False) -> tuple[Any, float]:
        """J [N, N] or, where windows are weighted, the cells of one output pixel by the naive twin; and ρ."""
        return cells.window(self.images, self.sampling, self.columns, self.position(row, col), self.valid, weighed)

    def cut(self, row: int, col: int, sampling: Sampling, columns: ColumnSet) -> Cut | None:
        """What the mask makes of the window of one output pixel; None where it is whole."""
        if self.valid is None:
            return None
        images = np.zeros((len(self.valid), 1, 1, *self.valid.shape[1:]))
        alone = replace(sampling, sx=AxisSampling(), sy=AxisSampling())
        _, seen = chain.window_of(images, alone, column_set(MODELS["flow"], "none", (), {}), self.position(row, col),
                                  self.valid)  # fmt: skip
        return None if seen.all() else Cut.of(seen, sampling, columns)

    def solved(self, row: int, col: int, problem: Problem) -> tuple[chain.Solved, list[chain.Solved]]:
        """What the naive twin finds at one output pixel, and from every camera's own flow."""

        def solve(J: Any, rho: float, sampling: Sampling, columns: ColumnSet) -> chain.Solved:
            if weighed:
                return weighted.estimate(J, problem).solved(rho, ESTIMATORS[problem.estimator].biased)
            cut = self.cut(row, col, sampling, columns) if problem.cut else None
            return chain.Solved.of(J, rho, columns, sampling, problem.estimator, problem.scale, cut)

        weighed = ESTIMATORS[problem.estimator].weighs
        own = self.own_reference(row, col, weighed) if problem.own_flows else []
        return (
            solve(*self.reference(row, col, weighed), self.sampling, self.columns),
            [solve(*one, *self.own_columns) for one in own],
        )

    @property
    def scene(self) -> PlaneScene:
        """What the reference camera of ``rendered`` sees."""
        return replace(SCENE, size=self.images.shape[:2:-1])

    @property
    def view(self) -> View:
        """Camera and output grid; the principal point is the one of ``rendered``."""
        height, width = self.images.shape[3:]
        x, y = self.position(0, 0)
        return View(
            SCENE.f_px, ((width - 1) / 2, (height - 1) / 2), SCENE.baseline_mm, PRESHIFT, x, y,
            self.band.stride, self.band.rows, self.band.cols, self._tensor[0].out_pitch,
        )  # fmt: skip

    def estimate(self, motion: str | None = None, rows: str = "auto", **options: Any) -> Estimated:
        """Run the per-pixel stages; ``motion`` None: without the motion fit.

        ``without``: own flows (by number) that are left out; ``lost``: own flows whose windows hold nothing.
        ``apart``: as ``EstimateStage`` has it; without it, only the maps are right.
        """
        from leafflow_ti.kernels.workspace import Region

        stage, tensors = self._pushed(ESTIMATORS[options.get("estimator", Problem.estimator)].weighs)
        sources = stage.sources
        apart = bool(options.pop("apart", True))
        if motion is not None:
            model = MODELS[self.model]
            offsets, use_range = parse_rows(rows if model.reference_rows else "2d", self.model, motion, self.columns)
            options |= {"offsets": offsets, "use_range": use_range, "fitted": unknowns_of(motion, self.columns)}
            if model.own_flows:
                sampling, columns = self.own_columns
                own = tuple(o for o in offsets if columns.index("x", o) is not None) if model.reference_rows else ("1",)
                unknowns = unknowns_of(motion, columns, all_cameras=True)
                growth = bool(options.pop("growth", "x" in own))
                without = options.pop("without", ())
                kept = [i for i in range(len(self.steps)) if i not in without]
                lost = options.pop("lost", ())
                if lost or without:
                    assert not sources
                    tensors = self._chosen(kept, lost)
                options["own_flows"] = OwnFlows(
                    columns,
                    sampling,
                    tuple(self.steps[i] for i in kept),
                    own,
                    unknowns,
                    model.reference_rows,
                    growth,
                    tuple(self.places[i] for i in kept) if self.places else (),
                )
        elif not self.sampling.camera_axes:
            options["offsets"] = flow_offsets(self.columns)
        options.setdefault("cut", self.valid is not None)
        problem = Problem(self.columns, self.sampling, **options)
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("leafflow_ti.stages.estimate.BATCH_BYTES", 64 << 20)  # one batch: its workspace is looked at
            stage = EstimateStage(self.device, problem, self.layout, self.view, apart=apart, sources=sources)
        planes = np.array(stage(tensors))
        k, flow = self.columns.n_time_like, self.columns.n_flow
        if not apart:
            return Estimated(problem, planes, np.empty(0), np.empty(0))
        parameters = self._region(stage, Region.PARAMETERS, k * flow)
        variance = self._region(stage, Region.VARIANCE, k)
        return Estimated(problem, planes, parameters.reshape(*parameters.shape[:2], k, flow), variance)

    def _chosen(self, kept: Sequence[int], lost: Sequence[int]) -> Any:
        """The grid's tensor and those of the ``kept`` own flows; of these, ``lost`` ones are all zero.

        Without what windows are weighted by: for estimators that do not.
        """
        stage, tensors = self._tensor
        own = TensorLayout.of(self.own_columns[1])
        sizes = [len(layout.entries) + EXTRA_PLANES for layout in (self.layout, *[own] * len(self.steps))]
        starts = np.cumsum([0, *sizes]) * self.band.rows * stage.out_pitch
        parts = np.split(np.array(self.device.host(tensors)), starts[1:])
        own_parts = [parts[1 + i] * (n not in lost) for n, i in enumerate(kept)]
        return self.device.array(np.concatenate([parts[0], *own_parts]))

    def _region(self, stage: EstimateStage, region: int, size: int) -> np.ndarray:
        """A region of the workspace, [rows, cols, size]."""
        lanes, groups = self.device.dense.lanes, self.band.rows * stage._row_groups
        pixels, n, first = groups * lanes, stage.layout.n_elements, stage.layout.offsets[region]
        assert stage._groups >= groups, "the block is too large to be one batch"
        workspace = np.array(self.device.host(stage._workspace))[: n * pixels]
        # On the CPU the lanes of a group are neighbours, on a GPU the groups are: see kernels/dense.py.
        if self.device.gpu:
            found = workspace.reshape(n, pixels)
        else:
            found = workspace.reshape(groups, n, lanes).transpose(1, 0, 2).reshape(n, pixels)
        return found[first : first + size].T.reshape(self.band.rows, -1, size)[:, : self.band.cols]


MakeBench = Callable[..., Bench]


@pytest.fixture(params=CASES, ids="-".join)
def case(request: pytest.FixtureRequest) -> tuple[str, str, str]:
    """Model, brightness and grid: the test runs for all ``CASES``."""
    return request.param


@pytest.fixture(params=["f64", "f32"])
def precision(request: pytest.FixtureRequest) -> str:
    """The test runs in both precisions."""
    return request.param


@pytest.fixture(scope="session")
def device() -> Callable[[str], Device]:
    """The device of this process (``LEAFFLOW_TI_ARCH``, else the CPU) in a precision."""
    return functools.cache(lambda precision: start("auto", precision))


@pytest.fixture(scope="session")
def bench(device: Callable[[str], Device]) -> MakeBench:
    """``bench(model, brightness, grid, precision)``: the scene as that model sees it."""

    @functools.cache
    def make(
        model: str, brightness: str, grid: str, precision: str,
        stride: int = STRIDE, cols: int = COLS, terms: str = "none",
    ) -> Bench:  # fmt: skip
        sampling = sampling_of(grid, MODELS[model].time, cameras=MODELS[model].cameras)
        band = Band.of(sampling, ROWS, cols, stride)
        scene = replace(SCENE, brightness=LIGHT if brightness != "none" else ())
        images = rendered(scene, grid, (band.in_cols, band.in_rows))
        if MODELS[model].cameras == "line" and min(GRIDS[grid]) > 1:
            images = images[:, GRIDS[grid][0] // 2][:, None]
        if not MODELS[model].time:
            images = images[SCENE.n_frames // 2][None]
        columns = column_set(MODELS[model], brightness, sampling.camera_axes, sampling.sampled, terms)
        return Bench(device(precision), images, sampling, columns, band, model, None, brightness, terms)

    return make


@pytest.fixture(scope="session")
def make_bench(device: Callable[[str], Device]) -> MakeBench:
    """A bench for given images [t, sy, sx, y, x], with as many output pixels as they allow."""

    def make(
        images: np.ndarray, sampling: Sampling, columns: ColumnSet, precision: str = "f64",
        shape: Sequence[int] = (1, 1), stride: int = 1, valid: np.ndarray | None = None,
    ) -> Bench:  # fmt: skip
        band = Band.of(sampling, *shape, stride)
        assert images.shape[3:] == (band.in_rows, band.in_cols)
        return Bench(device(precision), images, sampling, columns, band, valid=valid)

    return make
