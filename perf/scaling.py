"""What a frame of a sequence costs against the size of the image, the cameras, the window, the stride and the model.

Everything else is as in the ``stages`` case. σ and the window's size go together: 3.4 σ wide, as 65 pixels are for 19.
``affine-4d`` sees the cameras under its window alone: what a camera costs is told of ``affine-scene-flow``, a single
frame from images in memory to maps.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

from leafflow_ti.api import estimate
from leafflow_ti.runtime import Device, start
from perf.bench import Scene, median_seconds, time_stages
from perf.cases import Options
from perf.curves import Curves, draw_curves
from perf.figures import Figure, Outcome

LINEAR = 1.25
"""Most that a pixel of the largest image may cost over one of the smallest: halos weigh less, caches fill up."""
WIDTH = 65 / 19
"""Window over σ."""
SIGMA_FREE = 1.3
"""Most that a frame at the largest σ may cost over the smallest, at fixed stride."""
COLUMNS: tuple[tuple[str, dict[str, Any]], ...] = (
    ("flow", {"model": "flow"}),
    ("affine-translation", {"model": "affine-translation"}),
    ("affine", {"model": "affine"}),
    ("affine-4d", {}),
    ("affine-4d, temporal", {"brightness": "temporal"}),
    ("affine-4d, camera", {"brightness": "camera"}),
    ("affine-4d, second order", {"brightness": "camera", "brightness_terms": "both"}),
)


@dataclass(frozen=True)
class Settings:
    """Abscissae of the panels. All but the first have ``out_px`` squared pixels; σ and cameras ``sigma_stride``."""

    out_px: int = 200
    sizes: tuple[int, ...] = (75, 150, 300, 450)
    cameras: tuple[int, ...] = (5, 7, 9, 11, 13)
    windows: tuple[int, ...] = (17, 33, 49, 65, 81, 97)
    strides: tuple[int, ...] = (1, 2, 4, 8)
    sigmas: tuple[float, ...] = (5.0, 9.5, 19.0, 28.5)
    sigma_stride: int = 4
    columns: tuple[tuple[str, dict[str, Any]], ...] = COLUMNS
    repeats: int = 3


STAGES = {
    "a": "A filters, products", "b": "B windows", "c": "C null space, fit", "sequence": "a frame of a sequence",
    "whole": "affine-scene-flow, a single frame",
}  # fmt: skip


@dataclass
class Panel:
    """Times [us] per unit of work against an abscissa, a curve for each key of ``STAGES``."""

    title: str
    abscissa: str
    work: str
    x: list[float] = field(default_factory=list)
    us: dict[str, list[float]] = field(default_factory=dict)

    def add(self, x: float, seconds: dict[str, float], units: int) -> None:
        """A point of every curve."""
        self.x.append(x)
        for stage, value in seconds.items():
            self.us.setdefault(stage, []).append(1e6 * value / units)

    @property
    def total(self) -> list[float]:
        """The last curve: all stages together."""
        return list(self.us.values())[-1]


def _odd(n: float) -> int:
    return 2 * round((n - 1) / 2) + 1


def _panels(settings: Settings, device: Device) -> list[Panel]:
    base = Scene(out_px=settings.out_px)

    def timed(scene: Scene, **options: Any) -> tuple[dict[str, float], int, int]:
        """Seconds per stage, output pixels, columns."""
        capture = scene.capture()
        plan = scene.plan(capture, **options)
        found = time_stages(plan, capture, device, settings.repeats)
        seconds = {stage: getattr(found, stage) for stage in ("a", "b", "c", "sequence")}
        return seconds, len(plan.y) * len(plan.x), plan.problem.columns.n

    size = Panel("image size", "side of the output [px]", "output pixel")
    for side in settings.sizes:
        seconds, pixels, _ = timed(replace(base, out_px=side))
        size.add(float(side), seconds, pixels)
    window = Panel("window", "window [px], stride 1", "output pixel")
    for n in settings.windows:
        seconds, pixels, _ = timed(replace(base, window=n, sigma=n / WIDTH))
        window.add(float(n), seconds, pixels)
    stride = Panel("stride", "stride [px]", "input pixel")
    for n in settings.strides:
        seconds, pixels, _ = timed(base, stride=n)
        stride.add(float(n), seconds, pixels * n**2)
    sigma = Panel("sigma", f"sigma [px], stride {settings.sigma_stride}", "output pixel")
    for value in settings.sigmas:
        scene = replace(base, window=_odd(WIDTH * value), sigma=value)
        seconds, pixels, _ = timed(scene, stride=settings.sigma_stride)
        sigma.add(value, seconds, pixels)
    columns = Panel("columns", "columns of the model", "output pixel")
    for _, options in settings.columns:
        seconds, pixels, n = timed(base, **options)
        columns.add(float(n), seconds, pixels)
    return [size, _cameras(settings, base), window, stride, sigma, columns]


def _cameras(settings: Settings, base: Scene) -> Panel:
    panel = Panel("cameras", "cameras in a row", "output pixel")
    for n in settings.cameras:
        scene = replace(base, cameras=n)
        capture = scene.capture()
        options = scene.options(capture, model="affine-scene-flow", stride=settings.sigma_stride)
        pixels = estimate(capture, **options).status.size
        panel.add(
            float(n), {"whole": median_seconds(lambda c=capture, o=options: estimate(c, **o), settings.repeats)}, pixels
        )
    return panel


def _curves(panel: Panel) -> Curves:
    """The diagram of a panel, from 0 on: proportions count."""
    top = 1.08 * max(map(max, panel.us.values()))
    values = {STAGES[stage]: us for stage, us in panel.us.items()}
    return Curves(panel.title, panel.abscissa, f"us per {panel.work}", panel.x, values, limits=(0.0, top))


def measure(settings: Settings, folder: Path) -> Outcome:
    """All panels, as figures and as a picture."""
    device = start()
    panels = _panels(settings, device)
    figures = [
        Figure(f"{panel.title}: {x:g}", us, f"us per {panel.work}")
        for panel in panels
        for x, us in zip(panel.x, panel.total, strict=True)
    ]
    by_title = {panel.title: panel.total for panel in panels}
    size, sigma = by_title["image size"], by_title["sigma"]
    figures += [
        Figure("a pixel of the largest image over one of the smallest", size[-1] / size[0], "x", LINEAR),
        Figure("a frame at the largest sigma over the smallest", sigma[-1] / sigma[0], "x", SIGMA_FREE),
    ]
    picture = draw_curves(folder / "scaling.svg", [_curves(panel) for panel in panels], columns=3)
    return Outcome(tuple(figures), asdict(settings), (f"device: {device}",), (picture,))


def run(options: Options) -> Outcome:
    """The case; quick: two points a panel, small images, one repetition."""
    small = Settings(
        48, (32, 64), (7, 9), (17, 33), (1, 2), (5.0, 9.5), 2, (COLUMNS[0], COLUMNS[2]), repeats=1
    )  # fmt: skip
    return measure(small if options.quick else Settings(), options.out)
