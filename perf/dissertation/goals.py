"""All experiments in the order of the dissertation, and the goals that their records are held to."""

from __future__ import annotations

from typing import Any

from perf.dissertation import chapter3, chapter4, chapter56
from perf.dissertation.cells import Check, Goal
from perf.dissertation.chapter4 import COMBINED, CUBE_41
from perf.dissertation.chapter56 import CUBE_51, CUBE_61

EXPERIMENTS = (*chapter3.EXPERIMENTS, *chapter4.EXPERIMENTS, *chapter56.EXPERIMENTS)

SIDES = ("left", "right")
ROTATING, LIT, SPOT = (("table-5.1", CUBE_51.name), ("table-6.1", CUBE_61.name), ("table-4.1", CUBE_41.name))


SMALL_DIFFERENCE = (
    "On both faces the flow of all cameras decides about N; the affine rows change it by a small part of its spread."
)


def _check(home: tuple[str, str], variant: str, side: str, quantity: str, limit: Any, statistic: str = "mean") -> Check:
    experiment, panel = home
    selection = {"panel": panel, "variant": variant, "region": side, "quantity": quantity}
    reason = ""
    if isinstance(limit, str):  # another variant's value
        limit, reason = {**selection, "variant": limit}, SMALL_DIFFERENCE
    what = {"N": "AAE of N", "Omega": "AAE of Ω", "RGR": "growth rate"}[quantity]
    of = {"mean": "", "|mean|": ", size of the mean", "std": ", standard deviation"}[statistic]
    return Check(f"{variant}, {side} face: {what}{of}", experiment, selection, limit, statistic, reason)


def _both(
    home: tuple[str, str], variant: str, quantity: str, *limits: Any, statistic: str = "mean"
) -> tuple[Check, ...]:
    """One check per face; a single limit holds for both."""
    sides = zip(SIDES, limits * 2 if len(limits) == 1 else limits, strict=True)
    return tuple(_check(home, variant, side, quantity, limit, statistic) for side, limit in sides)


def _growth(home: tuple[str, str], variant: str) -> tuple[Check, ...]:
    return _both(home, variant, "RGR", 0.005, statistic="|mean|") + _both(home, variant, "RGR", 0.04, statistic="std")


GOALS = (
    Goal(
        "Rotating cube, constant light",
        _both(ROTATING, "Scene Flow", "N", 0.055)
        + _both(ROTATING, "Affine Scene Flow", "N", 0.12, 0.06)
        + _both(ROTATING, "Affine Scene Flow", "N", "Scene Flow")
        + _both(ROTATING, "Affine Scene Flow", "Omega", 0.003),
    ),
    Goal(
        "Rotating cube, light that moves with the camera",
        _both(LIT, "Affine Scene Flow", "N", 0.25) + _both(LIT, "Affine Scene Flow", "Omega", 0.025),
    ),
    Goal(
        "Translating cube, fixed spot",
        _both(SPOT, "TAYLOR, none", "N", 0.148, 0.056)
        + _both(SPOT, COMBINED[0].label, "N", 0.045)
        + _both(SPOT, COMBINED[1].label, "N", 0.1),
    ),
    Goal(
        "Growth of cubes that do not grow [%/frame]",
        _growth(ROTATING, "Affine Scene Flow")
        + _growth(ROTATING, "Scene Flow")
        + _growth(SPOT, COMBINED[1].label)
        + _growth(SPOT, COMBINED[0].label),
    ),
)
"""The goals on cubes; those on sinusoids are the shaded ranges of Figures 5.4, 5.5, 6.1 and 6.2."""


def find(name: str) -> chapter3.Experiment:
    """The experiment of this name; KeyError if there is none."""
    return {experiment.name: experiment for experiment in EXPERIMENTS}[name]
