"""The library beside NumPy/SciPy, numba, PyTorch and two packages: same run, same work, results compared.

NumPy/SciPy does the whole job, in double precision (``scipy_twin``): from the frames of one window, in memory, to maps
with error bars. Two ratios: (a) up to the flow parameters, its filters, windows and ``eigh`` against our A for every
frame of the window, B and null space; (b) the whole job against ``estimate``. numba and PyTorch do the three stages.
"""

from __future__ import annotations

import importlib
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.api import estimate
from leafflow_ti.capture import Capture
from leafflow_ti.plan import Plan
from leafflow_ti.runtime import Device, start
from perf import packages, scipy_twin
from perf.bench import Scene, Timed, median_seconds, time_stages
from perf.cases import Options
from perf.figures import Figure, Outcome

Array = NDArray[Any]
SAME_VALUES, SAME_ERRORS = 5e-3, 2e-3
"""Largest differences that single precision explains: of values, in standard errors; of standard errors, relative.
Images are rounded to 6e-8 of a signal some 50 times the noise, and fits weight by inverses of covariances."""
SAME_PARAMETERS = 1e-3
"""Largest difference of flow parameters, relative to the largest of their kind."""
TWINS = {"numba": ("perf.numba_twin", "NumbaTwin"), "PyTorch": ("perf.torch_twin", "TorchTwin")}
GOALS = {1: 20.0, 4: 100.0}
"""How many times as fast as NumPy/SciPy, by stride."""


@dataclass(frozen=True)
class Settings:
    """``repeats`` of ours and of the twins; ``scipy_repeats`` of NumPy/SciPy per stride and kind of windows."""

    scene: Scene = field(default_factory=Scene)
    strides: tuple[int, ...] = (1, 4)
    repeats: int = 9
    scipy_repeats: int = 3
    packages: packages.Settings = field(default_factory=packages.Settings)


@dataclass(frozen=True)
class Job:
    """One stride of the comparison: its plan, our times, and the images that others get."""

    capture: Capture
    plan: Plan
    ours: Timed
    stride: int

    @property
    def us(self) -> float:
        """Microseconds per output pixel of a second."""
        return 1e6 / (len(self.plan.y) * len(self.plan.x))

    def block(self, shrink: int = 0) -> Array:
        """Preshifted frames [t, sy, sx, y, x] that the output pixels reach, float32, less ``shrink`` at each side."""
        y0, y1, x0, x1 = scipy_twin.needed(self.plan)
        rows, cols = (y0 + shrink, y1 - shrink), (x0 + shrink, x1 - shrink)
        return self.capture.block(
            range(self.capture.n_frames), *self.plan.cameras, *rows, *cols, self.plan.preshift, np.float32
        )


def _scipy(job: Job, field: Any, whole_s: float, repeats: int) -> list[Figure]:
    """The whole job in NumPy/SciPy; the goals are for ``correlate1d``, windows by matrix products stand beside it."""
    images, label = job.block(), f"stride {job.stride}"
    figures = []
    for name, windowing in (
        ("correlate1d", scipy_twin.by_correlation), ("windows as matrix products", scipy_twin.by_products),
    ):  # fmt: skip
        clocks = [scipy_twin.Clock() for _ in range(repeats)]
        for clock in clocks:
            maps = scipy_twin.estimate(images, job.plan, clock, windowing)
        clock = sorted(clocks, key=lambda clock: clock.total)[repeats // 2]
        if name == "correlate1d":
            figures += _agreement(field, maps, label)
            figures += [
                Figure(f"NumPy/SciPy {stage}, {label}", seconds * job.us, "us/px")
                for stage, seconds in clock.seconds.items()
            ]
        low = GOALS.get(job.stride) if name == "correlate1d" else None
        figures += [
            Figure(f"NumPy/SciPy whole job, {name}, {label}", clock.total * job.us, "us/px"),
            Figure(f"(a) NumPy/SciPy over ours, three stages, {name}, {label}", clock.stages / job.ours.stages, "x"),
            Figure(f"(b) NumPy/SciPy over ours, whole job, {name}, {label}", clock.total / whole_s, "x", low=low),
        ]
    return figures


def _agreement(field: Any, maps: dict[str, Array], label: str) -> list[Figure]:
    """Largest differences of all maps, where ours has a value."""
    ok = np.isfinite(field["velocity_x"])
    values = {n: np.abs(field[n] - m)[ok] / maps[f"{n}_std"][ok] for n, m in maps.items() if not n.endswith("_std")}
    errors = {n: np.abs(field[n] / m - 1)[ok] for n, m in maps.items() if n.endswith("_std")}
    worst = [max(found, key=lambda n: found[n].max()) for found in (values, errors)]
    return [
        Figure(
            f"largest difference of values from NumPy/SciPy, {label}", float(values[worst[0]].max()), "std",
            SAME_VALUES, note=f"{worst[0]}; {ok.mean():.0%} of the pixels",
        ),
        Figure(
            f"largest difference of error bars, {label}", float(errors[worst[1]].max()), "", SAME_ERRORS,
            note=worst[1],
        ),
    ]  # fmt: skip


def _three_stages(name: str, twin: Any, job: Job, repeats: int) -> list[Figure]:
    """A twin of the three stages, one by one; its parameters beside those of NumPy/SciPy."""
    radius = job.plan.problem.sampling.x.filter_radius
    images = job.block(radius)[:, 0]
    taps = 2 * radius + 1
    frames = [np.ascontiguousarray(images[i : i + taps]) for i in range(len(images) - taps + 1)]
    maps = twin.stack([twin.filter(frame) for frame in frames])
    tensor = twin.tensor(maps)
    theirs = {
        "A": median_seconds(lambda: twin.filter(frames[0]), repeats),
        "B": median_seconds(lambda: twin.tensor(maps), repeats),
        "null space": median_seconds(lambda: twin.solve(tensor), repeats),
    }
    ours = {"A": job.ours.a, "B": job.ours.b, "null space": job.ours.null_space}
    figures = []
    for stage, seconds in theirs.items():
        label = f"{stage}, stride {job.stride}"
        figures += [
            Figure(f"{name} {label}", seconds * job.us, "us/px", note=f"ours {ours[stage] * job.us:.3g}"),
            Figure(f"{name} over ours, {label}", seconds / ours[stage], "x", low=1.0),
        ]
    difference = _parameter_difference(twin.solve(tensor), np.asarray(tensor), job.plan)
    return [
        *figures,
        Figure(f"{name}, largest difference of parameters, stride {job.stride}", difference, "", SAME_PARAMETERS),
    ]


def _parameter_difference(found: Array, tensor: Array, plan: Plan) -> float:
    """Of parameters [rows, cols, k, n_flow] from those that ``eigh`` finds in the same packed tensors."""
    columns, sampling = plan.problem.columns, plan.problem.sampling
    packed = tensor.astype(np.float64).reshape(len(tensor), -1)
    exact = scipy_twin.null_space(scipy_twin.unpacked(packed, columns, plan.layout.lower), columns, sampling)
    exact = exact.swapaxes(1, 2)
    return float((np.abs(found.reshape(exact.shape) - exact) / np.abs(exact).max(axis=0)).max())


def _peers(job: Job, device: Device, repeats: int) -> tuple[list[Figure], list[str]]:
    """numba and PyTorch, where installed."""
    figures: list[Figure] = []
    absent: list[str] = []
    for name, (home, kind) in TWINS.items():
        try:
            make = getattr(importlib.import_module(home), kind)
        except ImportError as missing:
            absent.append(f"{name}: skipped, {missing.name} is not installed")
        else:
            figures += _three_stages(name, make(job.plan, device.threads), job, repeats)
    return figures, absent


def measure(settings: Settings) -> Outcome:
    """Every comparison that is possible here."""
    scene, device = settings.scene, start()
    capture = scene.capture()
    figures: list[Figure] = []
    notes: list[str] = []
    for stride in settings.strides:
        # The same work: NumPy/SciPy gives no growth.
        maps = [n for n in scene.plan(capture, stride=stride).names if not n.startswith("growth")]
        plan = scene.plan(capture, stride=stride, arrays=maps)
        job = Job(capture, plan, time_stages(plan, capture, device, settings.repeats), stride)
        options = scene.options(capture, stride=stride, arrays=maps)
        field = estimate(capture, **options)
        whole_s = median_seconds(lambda options=options: estimate(capture, **options), settings.repeats)
        figures.append(Figure(f"ours, whole job, stride {stride}", whole_s * job.us, "us/px"))
        figures += _scipy(job, field, whole_s, settings.scipy_repeats)
        found, absent = _peers(job, device, settings.repeats)
        figures += found
        notes += [line for line in absent if line not in notes]
    found, absent = packages.measure(device, settings.packages)
    return Outcome((*figures, *found), asdict(settings), (f"device: {device}", *notes, *absent))


def run(options: Options) -> Outcome:
    """The case; quick: a small output, two repetitions."""
    small = Settings(Scene(out_px=64), repeats=2, scipy_repeats=1, packages=packages.Settings(256, 96, 24, 2))
    return measure(small if options.quick else Settings())
