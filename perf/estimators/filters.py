"""Table 2.1: the Yosemite sequence with every filter set and estimator, mean angular error and standard deviation."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from perf import yosemite
from perf.cases import Options
from perf.figures import Figure, Outcome
from perf.inputs import absent
from perf.pictures import Panel, draw

SETS = ("3x1x1", "3", "5", "7")
"""Those of the table."""
PRINTED = 3.1
"""Mean angular error [deg] at full density that is printed for the best of the table; the others are not at hand."""


@dataclass(frozen=True)
class Settings:
    """The window is that of the plain estimators of the case ``yosemite``; every ``stride``-th pixel."""

    estimators: tuple[str, ...] = (
        "ols",
        "tls",
        "tls-equilibrated",
        "sampson",
        "fns",
        "for3",
        "robust-ols",
        "robust-tls",
    )
    stride: int = 2


def run_settings(settings: Settings, out: Path) -> Outcome:
    """The table, and the error maps of the last estimator."""
    truth, folder = yosemite.Truth.read(), out / "yosemite"
    figures, panels = [], []
    means: dict[str, dict[str, float]] = {}
    for taps in SETS:
        for estimator in settings.estimators:
            field = yosemite.estimate_flow(
                folder, **yosemite.PLAIN, taps=taps, taps_time=taps, stride=settings.stride, estimator=estimator
            )
            error = yosemite.errors_of(field, truth)
            known = error[np.isfinite(error)]
            ground = np.count_nonzero(~truth.sky[np.ix_(field.y, field.x)])
            means.setdefault(estimator, {})[taps] = float(known.mean())
            note = f"± {known.std():.2f}, median {np.median(known):.2f}, density {100 * known.size / ground:.1f} %"
            high = PRINTED if taps == SETS[-1] else None
            figures.append(Figure(f"{taps} taps, {estimator}", float(known.mean()), "deg", high, "printed", note=note))
            if estimator == settings.estimators[-1]:
                panels.append(Panel(f"{taps} taps, {estimator}: angular error [deg]", error, (0, 20), "magma"))
    worst = max(mean[longer] / mean[shorter] for mean in means.values() for shorter, longer in pairwise(SETS))
    figures.append(Figure("longer filters over the next shorter ones, largest of all estimators", worst, "x", 1.0))
    notes = (
        "printed at full density; here pixels whose windows do not move as one have no value: see the densities",
        f"the case {yosemite.NAME} has what reaches full density",
    )
    return Outcome(tuple(figures), asdict(settings), notes, (draw(out / "estimators-filters.png", panels, 2, 5.0),))


def run(options: Options) -> Outcome:
    """The case; quick: every eighth pixel, one plain and one robust estimator."""
    reason = absent(yosemite.NAME)
    if reason:
        return Outcome(skipped=reason)
    settings = Settings(("tls-equilibrated", "robust-tls"), 8) if options.quick else Settings()
    return run_settings(settings, options.out)
