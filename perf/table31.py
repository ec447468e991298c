"""Table 3.1 of the dissertation: depth and slope of a sinusoidal plane from 1D and 2D camera grids.

Printed: Z0 = 100 mm, f = 10 mm, pixel pitch 7.4 µm, ZY = 45°, wavelengths 8 and 80 pixel, the pattern turned by α;
noise of 2.5 % of the grey range. Chosen here, because it is not printed: the camera step, the number of cameras, the
window, and the region. The integer preshift leaves less than one pixel of the disparity (printed below the table); it
is given, because a periodic texture does not tell it.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass, replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.capture import Geometry, capture_from_array
from leafflow_ti.synthetic.plane import PlaneScene, render, truth
from perf.cases import Options
from perf.figures import Figure, Outcome

Array = NDArray[np.float64]
F_PX, DEPTH_MM, RANGE = 10.0 / 0.0074, 100.0, 100.0
ALPHAS = (0, 30, 60, 90)

PRINTED: dict[tuple[float, int, str], tuple[float, ...] | None] = {
    (0.0, 1, "Z0"): (0.104, 0.119, 0.140, 0.128),
    (0.0, 2, "Z0"): (0.104, 0.108, 0.108, 0.104),
    (0.0, 1, "ZY"): (0.35, 5.40, 5.37, 0.001),
    (0.0, 2, "ZY"): (0.29, 0.23, 0.11, 0.01),
    (2.5, 1, "Z0"): (0.44, 2.07, 2.80, 3.71),
    (2.5, 2, "Z0"): (0.43, 0.41, 0.31, 0.32),
    (2.5, 1, "ZY"): None,
    (2.5, 2, "ZY"): (26.9, 24.9, 17.9, 19.1),
}
"""(noise in % of the grey range, grid dimensions, quantity) -> standard deviation for each α; mm and degrees."""


@dataclass(frozen=True)
class Settings:
    """What is chosen here. ``sigma`` is well below a third of the window: where the Gaussian is cut at 1.7 σ, the
    step at its rim meets the 8-pixel wave, and the slope of the 1D grid at α = 90° varies by .007°."""

    cameras: int = 9
    baseline_mm: float = 0.5
    preshift_px: int = -7
    window: int = 65
    sigma: float = 10.0
    region_px: int = 33
    stride: int = 4
    seeds: int = 8
    alphas: tuple[int, ...] = ALPHAS


def scene(settings: Settings, dimensions: int, alpha: int, noise_percent: float, seed: int) -> PlaneScene:
    """The plane before the grid; images just large enough for the region, its windows and the preshift's border."""
    margin = settings.window // 2 + 4 + settings.cameras // 2 * abs(settings.preshift_px)
    side = settings.region_px + 2 * margin
    pixel_mm = DEPTH_MM / F_PX
    return PlaneScene(
        f_px=F_PX,
        baseline_mm=(settings.baseline_mm, settings.baseline_mm),
        n_cols=settings.cameras,
        n_rows=settings.cameras if dimensions == 2 else 1,
        n_frames=1,
        size=(side, side),
        noise=noise_percent / 100.0 * RANGE,
        seed=seed,
        centre=(0.0, 0.0, DEPTH_MM),
        zy=1.0,
        offset=RANGE,
        amplitude=RANGE / 2,
        wavelengths_mm=(8.0 * pixel_mm, 80.0 * pixel_mm),
        alpha=math.radians(alpha),
    )


def errors(settings: Settings, dimensions: int, plane: PlaneScene, **options: Any) -> tuple[Array, Array]:
    """Errors of depth [mm] and of the slope angle along y [deg] at every evaluated pixel that has a value."""
    from leafflow_ti.api import estimate

    step = (settings.baseline_mm, settings.baseline_mm if dimensions == 2 else 0.0)
    capture = capture_from_array(render(plane), Geometry(plane.f_px, plane.principal, step))
    first = (plane.size[0] - settings.region_px) // 2
    last = first + settings.region_px
    field = estimate(
        capture,
        model="depth",
        preshift=(settings.preshift_px, settings.preshift_px if dimensions == 2 else 0),
        window=settings.window,
        sigma=settings.sigma,
        stride=settings.stride,
        roi=(first, first, last, last),
        **options,
    )
    true = truth(plane)["depth"][np.ix_(field.y, field.x)]
    depth = (field["depth"] - true).ravel()
    slope = np.degrees(np.arctan(field["slope_y"].astype(float))).ravel() - 45.0
    kept = np.isfinite(depth)
    return depth[kept], slope[kept]


def cell(settings: Settings, dimensions: int, alpha: int, noise_percent: float) -> tuple[Array, Array]:
    """The errors of one cell of the table, over all its seeds."""
    seeds = settings.seeds if noise_percent else 1
    found = [
        errors(settings, dimensions, scene(settings, dimensions, alpha, noise_percent, seed)) for seed in range(seeds)
    ]
    return np.concatenate([depth for depth, _ in found]), np.concatenate([slope for _, slope in found])


def measure(settings: Settings) -> Outcome:
    """Every cell beside the printed value."""
    figures = []
    for noise, dimensions, alpha in product((0.0, 2.5), (1, 2), settings.alphas):
        for quantity, unit, values in zip(
            ("Z0", "ZY"), ("mm", "deg"), cell(settings, dimensions, alpha, noise), strict=True
        ):
            printed = PRINTED[noise, dimensions, quantity]
            figures.append(
                Figure(
                    f"{quantity} std, noise {noise:g} %, {dimensions}D grid, alpha {alpha:2d} deg",
                    float(values.std()) if values.size else math.nan,
                    unit,
                    printed[ALPHAS.index(alpha)] if printed else None,
                    "printed",
                    note=f"mean error {values.mean():+.2g} {unit}" if values.size else "no pixel has a value",
                )
            )
    nearest, farthest = (
        F_PX * settings.baseline_mm * (1 + s * settings.region_px / 2 / F_PX) / DEPTH_MM for s in (1, -1)
    )
    residual = max(abs(nearest + settings.preshift_px), abs(farthest + settings.preshift_px))
    notes = (
        f"residual disparity after the preshift: at most {residual:.2f} px per step in the region",
        "standard deviation over the region and, with noise, over independent seeds; 1D noisy ZY is not printed",
        "the printed figures come from an unknown, probably much smaller window and grid: compare with that in mind",
    )
    return Outcome(tuple(figures), asdict(settings), notes)


def run(options: Options) -> Outcome:
    """The case; quick: two seeds, two orientations, five cameras."""
    settings = Settings()
    return measure(replace(settings, seeds=2, alphas=(0, 90), cameras=5) if options.quick else settings)
