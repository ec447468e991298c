"""A camera that stands off its place, end to end: ``check`` finds it, its line goes into the description, and the depth
that was biased is no longer.

A tilted plane before seven cameras 1 mm apart is rendered once; noise is added anew for every repetition, each of which
is checked and measured by itself. The error of a repetition is the mean over its windows: their scatter says how well
the mean over repetitions is known, what the positions were mistaken by included.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np

import leafflow_ti as lf
from leafflow_ti.capture import ArrayCapture, Geometry, capture_from_array
from leafflow_ti.inspection_report import Report
from leafflow_ti.status import Status
from leafflow_ti.synthetic.plane import PlaneScene, render, truth
from perf.cases import Options
from perf.fields import Array
from perf.figures import Figure, Outcome

DISPLACED, OFF_MM = 5, 0.01
"""Which of the cameras, and by how much along x."""
NOISE = 1.0
FOUND_UM = 0.5
"""Goal for the error of the position that is found."""
DEPTH_MM, F_PX = 400.0, 5681.8
MEASURED: dict[str, Any] = {"model": "depth", "preshift": (-14, 0), "window": 31, "stride": 15}


@dataclass(frozen=True, kw_only=True)
class DisplacedScene(PlaneScene):
    """The textured plane; the camera ``DISPLACED`` of its row stands ``off_mm`` to the right of its place."""

    off_mm: float = OFF_MM

    def camera_position(self, row: int, col: int) -> Array:
        """See ``RigidScene``."""
        return super().camera_position(row, col) + np.array([self.off_mm * (col == DISPLACED), 0.0, 0.0])


SCENE = DisplacedScene(
    f_px=F_PX, baseline_mm=(1.0, 1.0), n_cols=7, n_frames=1, size=(300, 220), centre=(0.0, 0.0, DEPTH_MM), zx=0.3,
    zy=-0.2, texture="noise", wavelengths_mm=(6 * DEPTH_MM / F_PX, 40 * DEPTH_MM / F_PX), amplitude=25.0, offset=100.0,
    supersampling=3,
)  # fmt: skip
"""Some 14 px of disparity per step: 10 µm are .14 px."""
GEOMETRY = Geometry(F_PX, SCENE.principal, (1.0, 0.0))


@cache
def images(off_mm: float = OFF_MM) -> Array:
    """Images [t, sy, sx, y, x] without noise."""
    return render(replace(SCENE, off_mm=off_mm))


def capture(seed: int, positions: Any = None) -> ArrayCapture:
    """A repetition with its noise; ``positions``: of the cameras, where they are known."""
    noise = np.random.default_rng(seed).standard_normal(images().shape)
    return capture_from_array((images() + NOISE * noise).astype(np.float32), GEOMETRY, positions_mm=positions)


def pasted(found: Report) -> Any:
    """The positions as the line of a report has them."""
    assert found.positions_line is not None
    return json.loads(found.positions_line.partition("= ")[2])


def depth_error(field: lf.Field) -> float:
    """Mean error over all windows [mm]."""
    ok = field.status == Status.OK
    return float(np.mean((field["depth"] - truth(SCENE)["depth"][np.ix_(field.y, field.x)])[ok]))


@dataclass(frozen=True)
class Errors:
    """Of some repetitions [n]: position of the displaced camera [µm] (with its stated standard error), mean depth error
    without and with the positions that were found [mm]."""

    off_um: Array
    stated_um: Array
    without: Array
    corrected: Array


def measure(seeds: int, **options: Any) -> Errors:
    """``options`` of ``estimate`` beside ``MEASURED``."""
    rows = []
    for seed in range(seeds):
        found = lf.check(capture(seed))
        camera = found.cameras[DISPLACED]
        assert camera.off_um is not None
        assert camera.off_error_um is not None
        errors = (
            depth_error(lf.estimate(capture(seed, positions), **{**MEASURED, **options}))
            for positions in (None, pasted(found))
        )
        rows.append((camera.off_um[0], camera.off_error_um[0], *errors))
    return Errors(*np.array(rows).T)


def mean_and_error(values: Array) -> tuple[float, float]:
    """The mean of independent values, and its standard error."""
    return float(values.mean()), float(values.std(ddof=1) / np.sqrt(len(values)))


def run(options: Options) -> Outcome:
    """The case; quick: fewer repetitions."""
    seeds = 4 if options.quick else 12
    figures = []
    for label, chosen in (("depth", {}), ("depth, refined", {"refine": 3})):
        found = measure(seeds, **chosen)
        off, error = mean_and_error(found.off_um)
        if not chosen:
            scatter, stated = found.off_um.std(ddof=1), found.stated_um.mean()
            note = f"10 µm found as {off:.3f} ± {error:.3f}; scatter {scatter:.3f}, stated {stated:.3f}"
            figures.append(
                Figure("displaced camera, error of its position", abs(off - 1e3 * OFF_MM), "µm", FOUND_UM, note=note)
            )
        for name, values, limit in (("as it is", found.without, None), ("positions pasted", found.corrected, 2.0)):
            mean, error = mean_and_error(values)
            note = f"{mean:+.4f} ± {error:.4f} mm of {DEPTH_MM:g}"
            title = f"{label}, {name}: mean error over its standard error"
            figures.append(Figure(title, abs(mean) / error, "", limit, note=note))
    return Outcome(tuple(figures), {"repetitions": seeds, "noise": NOISE, "off_mm": OFF_MM})
