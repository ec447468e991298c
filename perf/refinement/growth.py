"""Growth of a leaf: a patch before the tobacco rig of the dissertation that grows while it moves, turns and tilts.

f = 25 mm at 4.4 µm per pixel, 250 mm away, cameras 1 mm apart; images only as large as the windows need.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.errors import UsageError
from leafflow_ti.synthetic.bound import cramer_rao
from leafflow_ti.synthetic.plane import PlaneScene, linear_growth
from perf.cases import Options
from perf.dissertation import scenes
from perf.figures import Figure, Outcome
from perf.refinement.common import STANDARD, Pair, measure, rms

GOALS = {0.0: 0.002, 1.0: 0.006}
"""Noise [grey values] -> largest error allowed [%/frame]."""
PRESHIFT_PX = -23
MARGIN_PX = 70
"""Around the output: half a window, motion, disparity beyond the preshift, filters."""
TURN = np.array([2.0, 3.0, 2.0]) / math.sqrt(17.0)
STRAINS = ("11", "22", "12")


@dataclass(frozen=True)
class Settings:
    """``area`` growth and ``strain`` rates [%/frame]; ``rows`` of cameras; ``turn`` [deg/frame] about an oblique axis.

    Output: every ``stride``-th pixel of ``out_px`` squared; ``seeds`` of noise.
    """

    area: float = 0.1
    strain: tuple[float, float, float] = (0.08, 0.02, 0.03)
    slopes: tuple[tuple[float, float], ...] = ((0.0, 0.0), (0.4, -0.3), (1.0, 0.5))
    turn: float = 0.3
    velocity: tuple[float, float, float] = (0.04, -0.03, 0.05)
    rows: int = 1
    steps: int = 8
    thin: int = 2
    out_px: int = 33
    stride: int = 16
    seeds: int = 5


def leaf(settings: Settings, slopes: tuple[float, float], **changes: Any) -> PlaneScene:
    """The moving patch of these slopes, with noise for texture; what grows is told by ``changes``."""
    side = settings.out_px + 2 * MARGIN_PX
    along = side + 8 * abs(PRESHIFT_PX)
    omega = (math.radians(settings.turn) * TURN).tolist()
    scene = PlaneScene(
        f_px=25.0 / 0.0044, baseline_mm=(1.0, 1.0), n_rows=settings.rows, bits=8, centre=(0.0, 0.0, 250.0),
        size=(along, along if settings.rows > 1 else side), zx=slopes[0], zy=slopes[1], velocity=settings.velocity,
        omega=(omega[0], omega[1], omega[2]), texture="noise", wavelengths_mm=(0.3, 1.2), offset=120.0, amplitude=27.0,
    )  # fmt: skip
    return replace(scene, **changes)


def _pairs(scene: PlaneScene, settings: Settings, deformation: str) -> list[Pair]:
    x, y = ((n - settings.out_px) // 2 for n in scene.size)
    vertical = PRESHIFT_PX if settings.rows > 1 else 0
    return [
        measure(
            scenes.capture(scene, seed), scenes.truth(scene), settings.steps, thin=settings.thin,
            preshift=(PRESHIFT_PX, vertical), roi=(x, y, x + settings.out_px, y + settings.out_px),
            stride=settings.stride, deformation=deformation,
        )
        for seed in range(settings.seeds if scene.noise > 0.0 else 1)
    ]  # fmt: skip


def _stack(pairs: list[Pair], name: str, which: str = "refined") -> NDArray[Any]:
    return np.stack([pair.error(name, which) for pair in pairs])


def _bound(scene: PlaneScene, modes: int) -> NDArray[Any] | None:
    """Least standard errors [modes] of the strain rates in %/frame in the middle; None: not determined."""
    x, y = (n // 2 for n in scene.size)
    try:
        covariance = cramer_rao(scene, x, y, STANDARD["window"], modes=modes, sigma=STANDARD["sigma"])
    except UsageError:
        return None
    return np.asarray(100.0 * scene.noise * np.sqrt(np.diag(covariance))[-modes:])


def _label(scene: PlaneScene) -> str:
    return f"slopes {scene.zx:g}, {scene.zy:g}, noise {scene.noise:g}"


def _isotropic(settings: Settings, noise: float) -> Iterator[Figure]:
    for slopes in settings.slopes:
        scene = leaf(settings, slopes, growth=linear_growth(settings.area), noise=noise)
        pairs = _pairs(scene, settings, "growth")
        error = _stack(pairs, "growth_rate")
        known = float(np.mean(np.isfinite(error)))
        kept = float(np.mean([pair.kept for pair in pairs]))
        note = f"largest {np.nanmax(np.abs(error)):.2g}, affine {rms(_stack(pairs, 'growth_rate', 'start')):.2g}"
        bound = _bound(scene, 1) if noise > 0.0 else None
        if bound is not None:
            note += f", bound {2.0 * bound[0]:.2g}"  # the area grows twice as fast as lengths
        yield Figure(f"growth, {_label(scene)}", rms(error), "%/frame", GOALS[noise], note=note)
        yield Figure(f"growth, {_label(scene)}: windows refined", known - kept, "", low=1.0)


def _anisotropic(settings: Settings, noise: float) -> Iterator[Figure]:
    rates = tuple(rate / 100.0 for rate in settings.strain)
    for slopes in settings.slopes:
        scene = leaf(settings, slopes, strain=rates, noise=noise)
        pairs = _pairs(scene, settings, "strain")
        bound = _bound(scene, 3) if noise > 0.0 else None
        for i, pair in enumerate(STRAINS):
            name = f"strain_rate_{pair}"
            bar, error = rms(np.stack([found.refined[f"{name}_std"] for found in pairs])), rms(_stack(pairs, name))
            note = f"{error:.2g} %/frame" + ("" if bound is None else f", bound {bound[i]:.2g}")
            yield Figure(f"strain {pair}, {_label(scene)}: error over error bar", error / bar, "", 1.3, note=note)


def run(options: Options) -> Outcome:
    """The case; quick: one sequence of noise, without strain."""
    settings = Settings(seeds=1) if options.quick else Settings()
    figures: list[Figure] = []
    for noise in GOALS:
        figures += _isotropic(settings, noise)
        if not options.quick:
            figures += _anisotropic(settings, noise)
    return Outcome(
        tuple(figures), asdict(settings), ("root mean squares over windows and sequences; printed scatter .04-.28",)
    )
