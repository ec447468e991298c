"""A growing seedling, 16 frames of one camera: a flow map to look at, and two lengths that can be checked without
truth.

Root tip and hook move up to ten pixels per frame, and the seedling is saturated inside: what moves is its outline.
The images are therefore binned, so that the motion is about one (binned) pixel per frame. Least squares: in the
smooth halo around the plant the noise is not what differs between model and image, and total least squares overshoots
there.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from leafflow_ti.capture import capture_from_array
from perf.cases import Options
from perf.fields import Array, vectors
from perf.figures import Figure, Outcome
from perf.inputs import absent, data_folder, described
from perf.pictures import Panel, draw, status_colours

NAME = "hypocotyl"
PLANT = 150.0
"""Grey value above which a pixel belongs to the plant (background 105-115, plant 200-255)."""


@dataclass(frozen=True)
class Settings:
    """``bin_px``: pixels that are averaged along x and y; the window is in binned pixels."""

    bin_px: int = 6
    window: int = 21
    taps: str = "5"
    size_time: int = 5
    estimator: str = "ols"
    border: str = "clip"
    end_px: int = 18


@dataclass(frozen=True, eq=False)
class Found:
    """Images [t, y, x] and flow [y, x, 2] on the binned grid, flow in (unbinned) px/frame."""

    images: Array
    frame: int
    flow: Array
    status: np.ndarray

    @property
    def plant(self) -> np.ndarray:
        """Where the plant is in the reference frame, [y, x]: the largest part above the threshold."""
        return _largest(self.images[self.frame] > PLANT)


def _largest(mask: np.ndarray) -> np.ndarray:
    from scipy.ndimage import label  # type: ignore[import-untyped]

    parts, _ = label(mask)
    sizes = np.bincount(parts.ravel())
    sizes[0] = 0
    return np.asarray(parts == np.argmax(sizes))


def estimate_growth(folder: Path, settings: Settings) -> Found:
    """Read and bin the images (the ``capture.toml`` is written into ``folder``), and estimate the middle frame."""
    from leafflow_ti.api import estimate

    capture = described(folder, {"images": {"pattern": str(data_folder(NAME) / "img{t:03d}.tif")}})
    n, size = capture.n_frames, settings.bin_px
    height, width = capture.height // size, capture.width // size
    images = np.stack(
        [
            capture.read(t, 0, 0, 0, height * size, 0, width * size)
            .reshape(height, size, width, size)
            .mean(axis=(1, 3))
            for t in range(n)
        ]
    )
    field = estimate(
        capture_from_array(images[:, None, None]),
        frame=n // 2,
        model="flow-affine",
        window=settings.window,
        taps=settings.taps,
        size_time=settings.size_time,
        estimator=settings.estimator,
        border=settings.border,
    )
    return Found(images, field.frame, size * vectors(field, "flow", "xy"), field.status)


def ends(found: Found, settings: Settings) -> dict[str, tuple[float, float]]:
    """Mean flow along y near the lowest and the highest point of the plant, and how fast these points move [px/frame].

    The points' speed is a straight line through their positions in all frames.
    """
    result = {}
    depth = max(1, settings.end_px // settings.bin_px)
    t = np.arange(len(found.images))
    rows = [np.flatnonzero(_largest(image > PLANT).any(axis=1)) for image in found.images]
    for name, last in (("root tip", True), ("hook", False)):
        y = np.array([(r[-1] if last else r[0]) * settings.bin_px for r in rows], dtype=float)
        edge = rows[found.frame][-1 if last else 0]
        first = edge - depth + 1 if last else edge
        near = found.plant.copy()
        near[:first] = near[first + depth :] = False
        result[name] = (float(np.nanmean(found.flow[near, 1])), float(np.polyfit(t, y, 1)[0]))
    return result


def measure(settings: Settings, out: Path) -> Outcome:
    """Flow near the two ends of the plant beside the motion of these ends, and the picture."""
    found = estimate_growth(out / "hypocotyl", settings)
    figures = []
    for name, (flow, speed) in ends(found, settings).items():
        figures += [
            Figure(f"flow along y, {name}", flow, "px/frame"),
            Figure(f"motion of the {name}", speed, "px/frame"),
        ]
    size = np.hypot(found.flow[..., 0], found.flow[..., 1])
    known = np.isfinite(size) & found.plant
    figures += [
        Figure("median flow on the plant", float(np.median(size[known])), "px/frame"),
        Figure("95 % quantile of the flow on the plant", float(np.quantile(size[known], 0.95)), "px/frame"),
        Figure("plant pixels with a value", 100 * float(known.sum() / found.plant.sum()), "%"),
    ]
    return Outcome(tuple(figures), asdict(settings), (), (_picture(out / "hypocotyl.png", found),))


def _picture(path: Path, found: Found) -> Path:
    y, x = np.nonzero(_largest(found.images[0] > PLANT) | _largest(found.images[-1] > PLANT))
    margin = 8
    part = slice(max(0, y.min() - margin), y.max() + margin), slice(max(0, x.min() - margin), x.max() + margin)
    arrows = np.where(found.plant[..., None], found.flow, np.nan)
    size = np.hypot(arrows[..., 0], arrows[..., 1])
    grey = (90.0, 255.0)
    panels = [
        Panel("first frame", found.images[0][part], grey, "gray"),
        Panel("last frame", found.images[-1][part], grey, "gray"),
        Panel("flow over the middle frame", found.images[found.frame][part], grey, "gray", arrows[part]),
        Panel("flow [px/frame]", size[part], (0, 10)),
        Panel("flow along y [px/frame]", arrows[part][..., 1], (-10, 10), "RdBu"),
        Panel("status", status_colours(found.status)[part]),
    ]
    return draw(path, panels, 3, 4.5)


def run(options: Options) -> Outcome:
    """The case; quick: the same, it is small."""
    reason = absent(NAME)
    return Outcome(skipped=reason) if reason else measure(Settings(), options.out)
