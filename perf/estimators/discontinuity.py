"""Figures 2.8 and 2.11: two half planes that move differently, and the error against the distance from where they meet.

2.8: the joint robust fit of all affine parameters against translation first, derivatives second, and against the
project's schedule, which also begins with a narrow window. 2.11: least squares, total least squares, and the robust fit
with each penalty. Motions, noise and window are this project's choice.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from perf.cases import Options
from perf.curves import Curves, draw_curves
from perf.estimators.patterns import AffineFlow, Array, Scene, angular_errors, measure
from perf.estimators.variants import JOINT, TRANSLATION_FIRST, replaced
from perf.figures import Figure, Outcome

ROBUST = {"estimator": "robust-tls", "robust": "all"}
CURVES: dict[str, dict[str, Any]] = {
    "OLS": {"estimator": "ols"},
    "TLS": {"estimator": "tls-equilibrated"},
    "truncated quadratic": {**ROBUST, "penalty": "truncated"},
    "Geman-McClure": {**ROBUST, "penalty": "geman-mcclure"},
    "Lorentzian": {**ROBUST, "penalty": "lorentzian"},
}
"""Figure 2.11: label -> options."""
PENALTIES = tuple(label for label in CURVES if "penalty" in CURVES[label])
BEST = "Lorentzian"
"""Which is best at discontinuities, as printed."""
SCHEDULES = {"joint": JOINT, "translation first": TRANSLATION_FIRST}
"""Label -> what takes the place of the project's own schedule."""
NO_VALUE = 90.0
"""Angular error [deg] of a pixel without a value."""

LEFT = AffineFlow((0.5, 0.9), ((0.004, -0.006), (0.006, 0.002)))
RIGHT = AffineFlow((-0.3, -0.5), ((-0.003, 0.004), (-0.005, 0.003)))


@dataclass(frozen=True)
class Settings:
    """Pixels up to ``reach`` px from the line, more than half a window, in ``rows`` rows, over ``seeds``. ``near`` px:
    where a window of half that size would still see both sides."""

    noise: float = 2.5
    window: int = 33
    reach: int = 24
    rows: int = 41
    near: int = 8
    seeds: int = 3

    @property
    def size(self) -> int:
        """Of the images [px]."""
        return max(2 * self.reach, self.rows) + self.window + 8


def errors(
    settings: Settings, options: dict[str, Any], motions: tuple[AffineFlow, AffineFlow] = (LEFT, RIGHT)
) -> Array:
    """Angular errors [seed, y, x] in degrees, ``NO_VALUE`` where there is no value; columns from -reach to reach - 1
    around the line, which lies left of the column ``reach``."""
    found = []
    for seed in range(settings.seeds):
        scene = Scene(LEFT, RIGHT, size=settings.size | 1, noise=settings.noise, seed=seed)
        middle = scene.size // 2
        roi = (
            middle - settings.reach, middle - settings.rows // 2,
            middle + settings.reach, middle + settings.rows // 2 + 1,
        )  # fmt: skip
        field = measure(scene.images(), model="flow-affine", window=settings.window, stride=1, roi=roi, **options)
        error = angular_errors(field, scene.truth)
        found.append(np.where(np.isnan(error), NO_VALUE, error))
    return np.stack(found)


def _shares(found: dict[str, Array], columns: NDArray[np.bool_]) -> dict[str, float]:
    """Mean errors [deg] over the columns, by label."""
    return {label: float(error[..., columns].mean()) for label, error in found.items()}


def _label(penalty: str, schedule: str) -> str:
    return f"{penalty}, {schedule}"


def _figures(settings: Settings, found: dict[str, Array], distance: Array) -> list[Figure]:
    """Errors near the line; where an ordering is printed the limit is what was measured of the others."""
    near = _shares(found, np.abs(distance) < settings.near)
    far = _shares(found, np.abs(distance) > settings.window // 2)
    limits: dict[str, tuple[float | None, float | None]] = {}
    for labels in (list(CURVES), [_label(penalty, "joint") for penalty in PENALTIES]):
        best = next(label for label in labels if label.startswith(BEST))
        limits[best] = (min(near[label] for label in labels if label != best), None)
    for penalty in PENALTIES:
        joint = _label(penalty, "joint")
        limits[joint] = (limits.get(joint, (None, None))[0], near[_label(penalty, "translation first")])
    figures = []
    for label in found:
        high, low = limits.get(label, (None, None))
        name, note = (
            f"within {settings.near} px of the line: {label}",
            f"beyond {settings.window // 2} px {far[label]:.3g}",
        )
        figures.append(Figure(name, near[label], "deg", high, "goal", low, note))
    return figures


def run_settings(settings: Settings, out: Path) -> Outcome:
    """Both figures. Orderings are printed: the Lorentzian is best, the joint fit worse than translation first."""
    found = {label: errors(settings, options) for label, options in CURVES.items()}
    for schedule, estimator in SCHEDULES.items():
        with replaced("robust-tls", estimator):
            found |= {_label(penalty, schedule): errors(settings, CURVES[penalty]) for penalty in PENALTIES}
    distance = np.arange(-settings.reach, settings.reach) + 0.5
    profile = {label: error.mean(axis=(0, 1)).tolist() for label, error in found.items()}
    axes = ("distance from the discontinuity [px]", "mean angular error [deg]", distance.tolist())
    joint = {label: profile[_label(label, "joint") if label in PENALTIES else label] for label in CURVES}
    schedules = {schedule: profile[_label(BEST, schedule)] for schedule in SCHEDULES} | {"as it is": profile[BEST]}
    picture = draw_curves(
        out / "estimators-discontinuity.png",
        [
            Curves("Figure 2.11", *axes, {label: profile[label] for label in CURVES}, y_log=True),
            Curves("Figure 2.11, all parameters jointly", *axes, joint, y_log=True),
            Curves(f"Figure 2.8: schedules of the {BEST}", *axes, schedules, y_log=True),
        ],
        3,
    )
    notes = (
        "the printed schedule is not at hand: in a joint fit the Lorentzian is the best of the three,",
        "with translation first those penalties are that forget outliers altogether",
    )
    return Outcome(tuple(_figures(settings, found, distance)), asdict(settings), notes, (picture,))


def run(options: Options) -> Outcome:
    """The case; quick: few rows and columns, one sequence."""
    return run_settings(Settings(reach=20, rows=3, seeds=1) if options.quick else Settings(), options.out)
