"""The Yosemite sequence: affine optical flow of one camera, frame 9, against its truth, without the sky.

Printed in the dissertation for the same model: 3.1° ± 7.6° at full density.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from leafflow_ti.field import Field
from leafflow_ti.metrics import aae
from perf.cases import Options
from perf.fields import Array, vectors
from perf.figures import Figure, Outcome
from perf.inputs import absent, data_folder, described
from perf.pictures import Panel, draw, status_colours

NAME = "yosemite"
FRAME_NUMBER = 9


@dataclass(frozen=True)
class Settings:
    """Options of ``run``: all 15 frames are used (7 taps and a window of 9); best of windows of 15 to 51 pixels."""

    taps: str = "7"
    taps_time: str = "7"
    window: int = 27
    size_time: int = 9
    sigma_time: float = 3.0
    border: str = "clip"
    stride: int = 1
    estimators: tuple[str, ...] = ("tls-equilibrated", "tls", "ols")


@dataclass(frozen=True, eq=False)
class Truth:
    """Flow [y, x, 2] in px/frame of frame 9, and where the sky is [y, x]."""

    flow: Array
    sky: np.ndarray

    @classmethod
    def read(cls) -> Truth:
        """From the files of the data set."""
        with np.load(data_folder(NAME) / "truth_frame9.npz") as file:
            return cls(np.stack([file["u"], file["v"]], axis=-1).astype(np.float64), file["sky"].astype(bool))


def estimate_flow(folder: Path, settings: Settings, estimator: str) -> Field:
    """The field of frame 9; the ``capture.toml`` is written into ``folder``."""
    from leafflow_ti.api import estimate

    capture = described(folder, {"images": {"pattern": str(data_folder(NAME) / "yos{t}.tif")}})
    return estimate(
        capture,
        frame=capture.frames.index(FRAME_NUMBER),
        model="flow-affine",
        taps=settings.taps,
        taps_time=settings.taps_time,
        window=settings.window,
        size_time=settings.size_time,
        sigma_time=settings.sigma_time,
        border=settings.border,
        stride=settings.stride,
        estimator=estimator,
    )


def errors_of(field: Field, truth: Truth) -> Array:
    """Angular errors [y, x] in degrees; NaN in the sky and where there is no value."""
    there = np.ix_(field.y, field.x)
    error = aae(vectors(field, "flow", "xy"), truth.flow[there])
    return np.where(truth.sky[there], np.nan, error)


def figures_of(label: str, field: Field, truth: Truth) -> tuple[Figure, ...]:
    """The figures of one measurement."""
    error = errors_of(field, truth)
    known = error[np.isfinite(error)]
    ground = int(np.count_nonzero(~truth.sky[np.ix_(field.y, field.x)]))
    return (
        Figure(f"AAE without sky, {label}", float(known.mean()), "deg", 3.1, "printed", note=f"± {known.std():.2f}"),
        Figure(f"median angular error, {label}", float(np.median(known)), "deg", 1.1),
        Figure(f"density, {label}", 100 * known.size / ground, "%"),
    )


def measure(settings: Settings, out: Path) -> Outcome:
    """All estimators."""
    truth = Truth.read()
    fields = {name: estimate_flow(out / "yosemite", settings, name) for name in settings.estimators}
    figures = tuple(figure for name, field in fields.items() for figure in figures_of(name, field, truth))
    first = fields[settings.estimators[0]]
    return Outcome(figures, asdict(settings), (), (_picture(out / "yosemite.png", first, truth),))


def _picture(path: Path, field: Field, truth: Truth) -> Path:
    there = np.ix_(field.y, field.x)
    found, true = vectors(field, "flow", "xy"), truth.flow[there]

    def ground(flow: Array) -> Array:
        return np.where(truth.sky[there][..., None], np.nan, flow)

    panels = [
        Panel("flow [px/frame]", np.hypot(found[..., 0], found[..., 1]), (0, 5), arrows=ground(found)),
        Panel("truth", np.hypot(true[..., 0], true[..., 1]), (0, 5), arrows=ground(true)),
        Panel("angular error without sky [deg]", errors_of(field, truth), (0, 10), "magma"),
        Panel("status", status_colours(field.status)),
    ]
    return draw(path, panels, 2, 5.0)


def run(options: Options) -> Outcome:
    """The case; quick: every fourth pixel, the default estimator."""
    reason = absent(NAME)
    if reason:
        return Outcome(skipped=reason)
    settings = Settings(stride=4, estimators=("tls-equilibrated",)) if options.quick else Settings()
    return measure(settings, options.out)
