"""Whether error bars are true: how often the truth lies within one and two of them, for every unknown and noise."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace

import numpy as np

from leafflow_ti.errors import RunError
from leafflow_ti.metrics import Coverage, coverage
from leafflow_ti.synthetic.plane import PlaneScene, noise_scene
from perf.cases import Options
from perf.dissertation import scenes
from perf.figures import Figure, Outcome
from perf.refinement.common import Pair, measure

WITHIN = {"within_1": (0.63, 0.73), "within_2": (0.92, 0.98)}
"""Share of the truths within one and two error bars, as a goal."""
MARGIN_PX = 66


@dataclass(frozen=True)
class Settings:
    """Output pixels two σ of the window apart, ``across`` squared, over ``seeds`` of every noise [grey values]."""

    noises: tuple[float, ...] = (0.5, 1.0, 2.5, 5.0, 10.0)
    across: int = 4
    apart_px: int = 38
    seeds: int = 40
    steps: int = 8
    thin: int = 3
    deformation: str = "auto"

    @property
    def side(self) -> int:
        """Of the output [px]."""
        return (self.across - 1) * self.apart_px + 1


def scene(settings: Settings) -> PlaneScene:
    """A turning plane with noise for texture, without noise of the camera."""
    side = settings.side + 2 * MARGIN_PX
    return replace(noise_scene((side + 8 * 14, side)), growth=2e-4)


def _measure(plane: PlaneScene, settings: Settings) -> Pair:
    x, y = ((n - settings.side) // 2 for n in plane.size)
    return measure(
        scenes.capture(plane, plane.seed), scenes.truth(plane), settings.steps, preshift=(-14, 0), thin=settings.thin,
        roi=(x, y, x + settings.side, y + settings.side), stride=settings.apart_px, deformation=settings.deformation,
    )  # fmt: skip


def covered(pairs: list[Pair]) -> dict[str, Coverage]:
    """Coverage of every unknown that has an error bar; pixels that kept the affine result are left out."""
    found = {}
    for name in pairs[0].true:
        if f"{name}_std" not in pairs[0].refined:
            continue
        values, true, std = (
            np.stack([np.where(pair.kept, np.nan, maps[key]) for pair in pairs for maps in [getattr(pair, which)]])
            for which, key in (("refined", name), ("true", name), ("refined", f"{name}_std"))
        )
        spread = coverage(values, true, std)
        if spread is None:
            raise RunError(f"{name}: no pixel has a refined value and an error bar")
        found[name] = spread
    return found


def _figures(noise: float, pairs: list[Pair]) -> list[Figure]:
    """The unknowns that are covered least and most, and the ratio of scatter and error bar."""
    shares = covered(pairs)
    figures = []
    for which, (low, high) in WITHIN.items():
        values = {name: getattr(spread, which) for name, spread in shares.items()}
        for word, pick in (("least", min), ("most", max)):
            name = pick(values, key=lambda key: values[key])
            label = f"noise {noise:g}: share within {which[-1]} error bar, {word} of all unknowns"
            figures.append(Figure(label, values[name], "", high, low=low, note=f"{name}, n = {shares[name].n}"))
    ratios = {name: spread.std for name, spread in shares.items()}
    note = ", ".join(f"{name} {ratio:.2f}" for name, ratio in ratios.items())
    figures.append(
        Figure(f"noise {noise:g}: scatter over error bar, mean", float(np.mean(list(ratios.values()))), note=note)
    )
    figures.append(
        Figure(f"noise {noise:g}: pixels that kept the affine result", float(np.mean([p.kept for p in pairs])))
    )
    return figures


def run(options: Options) -> Outcome:
    """The case; quick: one noise, three sequences."""
    settings = Settings((2.5,), seeds=3) if options.quick else Settings()
    plane = scene(settings)
    figures: list[Figure] = []
    for noise in settings.noises:
        noisy = replace(plane, noise=noise)
        figures += _figures(noise, [_measure(replace(noisy, seed=seed), settings) for seed in range(settings.seeds)])
    return Outcome(tuple(figures), asdict(settings))
