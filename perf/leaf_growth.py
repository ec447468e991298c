"""A curved leaf that grows, alike in all directions or along its axis alone, while it moves, tilts and changes its
brightness: growth as an unknown of the refinement, and from the motion, each against the truth and its error bars.

The rig is that of the tobacco: f = 25 mm at 4.4 µm per pixel, 250 mm away, a row of 9 cameras 1 mm apart, or
9 x 9 of them. Evaluated are pixels whose windows lie on the leaf.
"""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import tifffile

from leafflow_ti import metrics
from leafflow_ti.capture import Capture, Geometry, capture_from_array
from leafflow_ti.config import load_config
from leafflow_ti.results import ResultStore
from leafflow_ti.runs import run as run_capture
from leafflow_ti.surface_growth import measure_growth
from leafflow_ti.synthetic.leaf import LeafScene, isotropic, render_image, truth
from leafflow_ti.synthetic.material import BrightnessTerm
from leafflow_ti.synthetic.rig import Vector, render_grid
from perf.cases import Options
from perf.dissertation.scenes import rotation
from perf.fields import Array
from perf.figures import Figure, Outcome

REFINED, FROM_MOTION, DIRECTION = 0.004, 0.02, 5.0
"""Goals: root mean square errors of the area's growth [%/frame] and of the principal direction [°]."""
WITHIN = (0.63, 0.73)
"""Goal: share of the truths within one error bar."""
MEASURES = {
    "refined": ("growth_rate", "principal_angle", ("strain_rate_11", "strain_rate_22", "strain_rate_12"), REFINED),
    "from motion": (
        "area_rate", "surface_angle", ("surface_strain_11", "surface_strain_22", "surface_strain_12"), FROM_MOTION,
    ),
}  # fmt: skip
"""Measure -> its maps of area growth, of the principal direction and of strain, and the goal of the first."""
BASE_MM = 8.0
"""From the first camera to the last, along both axes."""
BORDER_PX = 4
"""Pixels that are left out at the outline beside half a window: what filters and motion add."""
LIGHT = (BrightnessTerm("t", 1, 0.01, 0.001, -0.001), BrightnessTerm("t", 2, -0.0005))


@dataclass(frozen=True)
class Variant:
    """One leaf and how it is measured. ``cameras`` (columns, rows) 8 mm from first to last; ``window`` [px] of the
    refinement: small ones see more noise, large ones more of what is beyond a curvature."""

    label: str
    growth: Vector
    deformation: str
    cameras: tuple[int, int]
    window: int


@dataclass(frozen=True)
class Settings:
    """The leaf, its variants, and options of every run; ``seeds`` of noise [grey values] where there is any."""

    leaf: LeafScene = field(
        default_factory=lambda: LeafScene(
            size=(521, 361), half_mm=(7.0, 5.0), omega=rotation(0.3), brightness=LIGHT, supersampling=2
        )
    )
    variants: tuple[Variant, ...] = (
        Variant("isotropic, 9 cameras", isotropic(0.1), "growth", (9, 1), window=49),
        Variant("along its axis, 9x9 cameras", (1e-3, 0.0, 0.0), "strain", (9, 9), window=65),
    )
    noises: tuple[float, ...] = (0.0, 1.0)
    seeds: int = 2
    stride: int = 8
    steps: int = 8
    thin: int = 2

    def scene(self, variant: Variant) -> LeafScene:
        """The leaf of a variant without noise; images as large as its cameras need."""
        (width, height), (cols, rows) = self.leaf.size, variant.cameras
        step = BASE_MM / (cols - 1)
        return replace(
            self.leaf, growth=variant.growth, n_cols=cols, n_rows=rows, baseline_mm=(step, step),
            size=(width, width if rows > 1 else height),
        )  # fmt: skip

    def options(self, variant: Variant, scene: LeafScene, known: Mapping[str, Array], mask: Path) -> dict[str, Any]:
        """Of ``run``."""
        y, x = np.nonzero(known["region"])
        shift = round(-scene.f_px * scene.baseline_mm[0] / scene.centre[2])
        return {
            "model": "affine-scene-flow", "preshift": (shift, shift if scene.n_rows > 1 else 0), "mask": str(mask),
            "roi": (int(x.min()), int(y.min()), int(x.max()) + 1, int(y.max()) + 1), "stride": self.stride,
            "brightness": "spatial", "deformation": variant.deformation, "refine": self.steps, "thin": self.thin,
            "refine_window": variant.window,
        }  # fmt: skip


def rendered(scene: LeafScene) -> Array:
    """Images [t, sy, sx, y, x] without noise and real, in single precision."""
    clean = replace(scene, bits=None)
    out = np.empty((scene.n_frames, scene.n_rows, scene.n_cols, *scene.size[::-1]), np.float32)
    for key in np.ndindex(out.shape[:3]):
        out[key] = render_image(clean, *key)
    return out


def exposed(scene: LeafScene, clean: Array) -> Capture:
    """The images of 8 bits with the scene's noise."""
    images = render_grid(scene, lambda *key: scene.expose(clean[key].astype(float), *key)).astype(np.uint8)
    step = (scene.baseline_mm[0], scene.baseline_mm[1] if scene.n_rows > 1 else 0.0)
    return capture_from_array(images, Geometry(scene.f_px, scene.principal, step), bits=scene.bits)


@dataclass(frozen=True)
class Measured:
    """Of one or several sequences: maps, their truth by its keys, and where windows lie on the leaf; all [y, x]."""

    maps: metrics.Maps
    truth: metrics.Maps
    inside: metrics.Mask

    @classmethod
    def together(cls, several: Sequence[Measured]) -> Measured:
        """All of them, one below the other."""
        maps, true = (
            {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}
            for parts in ([one.maps for one in several], [one.truth for one in several])
        )
        return cls(maps, true, np.concatenate([one.inside for one in several]))


def measured(settings: Settings, variant: Variant, scene: LeafScene, clean: Array) -> Measured:
    """One noisy sequence."""
    known = truth(scene)
    with tempfile.TemporaryDirectory() as folder:
        mask, out = Path(folder) / "mask.tif", Path(folder) / "out.zarr"
        tifffile.imwrite(mask, known["region"].astype(np.uint8))
        run_capture(exposed(scene, clean), out, load_config(overrides=settings.options(variant, scene, known, mask)))
        measure_growth(out)
        found = ResultStore.open(out).field(0).measured()
    inside = metrics.erode(known["region"] == 1, variant.window // 2 + BORDER_PX)[np.ix_(found.y, found.x)]
    return Measured(dict(found), metrics.sample_maps(known, found.y, found.x), inside)


def report(settings: Settings, variant: Variant, scene: LeafScene, clean: Array) -> metrics.RegionReport:
    """Errors and coverage over the leaf, all sequences of noise together."""
    seeds = range(settings.seeds if scene.noise > 0.0 else 1)
    all_ = Measured.together([measured(settings, variant, replace(scene, seed=seed), clean) for seed in seeds])
    return metrics.evaluate(all_.maps, all_.truth, {"leaf": all_.inside})["leaf"]


def rms(errors: metrics.Summary) -> float:
    """Their root mean square."""
    return float(np.hypot(errors.mean, errors.std))


def figures(found: metrics.RegionReport, variant: Variant, noise: float) -> Iterator[Figure]:
    """Of both measures: error of the area's growth, of the principal direction, and coverage where there is noise."""
    label = f"{variant.label}, noise {noise:g}"
    for measure, (area, direction, strains, goal) in MEASURES.items():
        error, where = found.errors[f"{area}_percent"], f"{label}, {measure}"
        note = f"95 % within {error.p95_abs:.2g}, {error.n} px"
        yield Figure(f"{where}: area, |mean error|", abs(error.mean), "%/frame", goal)
        yield Figure(f"{where}: area, rms error", rms(error), "%/frame", goal, note=note)
        if f"{direction}_deg" in found.errors:
            turn = found.errors[f"{direction}_deg"]
            yield Figure(f"{where}: principal direction, rms error", rms(turn), "deg", DIRECTION, note=f"{turn.n} px")
        for name in (area, *strains):
            if noise > 0.0 and name in found.coverage:
                bars = found.coverage[name]
                spread = f"error over error bar {bars.mean:+.2f} ± {bars.std:.2f}"
                yield Figure(
                    f"{label}, {name}: within one error bar", bars.within_1, "", WITHIN[1], low=WITHIN[0], note=spread
                )


def run(options: Options) -> Outcome:
    """The case; quick: isotropic growth, few pixels, one sequence of noise."""
    settings = Settings()
    if options.quick:
        settings = replace(settings, variants=settings.variants[:1], stride=24, seeds=1)
    found: list[Figure] = []
    for variant in settings.variants:
        scene = settings.scene(variant)
        clean = rendered(scene)
        for noise in settings.noises:
            noisy = replace(scene, noise=noise)
            found += figures(report(settings, variant, noisy, clean), variant, noise)
    return Outcome(tuple(found), asdict(settings))
