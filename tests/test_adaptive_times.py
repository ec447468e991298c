"""Fast motion at measured times: the search, the shifts in time and the maps all count in nominal intervals."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from reference.measured import MeasuredScene

import leafflow_ti as lf
from leafflow_ti.runtime import Device
from leafflow_ti.search import Coarse, Extent, coarse_search
from leafflow_ti.status import HAS_VALUE, Status
from leafflow_ti.synthetic.plane import render, truth

Z, F = 100.0, 1400.0
GAP = (-3.0, -2.0, -1.0, 0.0, 3.0, 4.0)
PAIR = (-0.5, 0.5)


@functools.cache
def scene(times: tuple[float, ...], px: float) -> MeasuredScene:
    """A tilted plane with a texture that does not repeat, moving by ``px`` along x and -.4 of it along y per frame."""
    return MeasuredScene(
        f_px=F, baseline_mm=(1.0, 1.0), n_cols=5, n_frames=len(times), size=(165, 125), centre=(0.3, -0.2, Z), zx=0.2,
        zy=-0.1, velocity=(px * Z / F, -0.4 * px * Z / F, 0.02), texture="noise",
        wavelengths_mm=(6 * Z / F, 30 * Z / F), amplitude=25.0, offset=110.0, supersampling=3, times=times,
    )  # fmt: skip


@functools.cache
def images(times: tuple[float, ...], px: float) -> np.ndarray:
    clean = render(scene(times, px))
    return (clean + 0.5 * np.random.default_rng(0).standard_normal(clean.shape)).astype(np.float32)


@pytest.mark.parametrize("refine", [0, 8])
@pytest.mark.parametrize(
    ("times", "frame", "px", "options"),
    [(GAP, 3, 4.0, {"taps_time": "3", "size_time": 1, "refine_frames": (2, 2)}), (PAIR, 0, 6.0, {})],
)
def test_fast_motion_at_measured_times(
    times: tuple[float, ...], frame: int, px: float, options: dict[str, Any], refine: int
) -> None:
    """A gap of three frames after the reference, and two frames alone, whose results lie between them. At the borders
    the refinement starts from the search, which takes more than three steps."""
    moving = scene(times, px)
    field = lf.estimate(
        moving.capture(images(times, px)), frame, model="affine-scene-flow", preshift="adaptive", window=31, stride=8,
        refine=refine, **options,
    )  # fmt: skip
    seen = ~np.isin(field.status, (Status.BORDER,))
    assert np.isin(field.status, HAS_VALUE)[seen].mean() > 0.95
    ok = field.status == Status.OK
    assert ok.mean() > (0.8 if refine else 0.5)
    wanted, there = truth(moving), np.ix_(field.y, field.x)
    for name in ("depth", "velocity_x", "velocity_y", "velocity_z"):
        value = wanted["depth"][there] if name == "depth" else wanted["velocity"][there][..., "xyz".index(name[-1])]
        error, bar = (field[name] - value)[ok].astype(float), np.median(field[f"{name}_std"][ok])
        # Windows overlap: some twelve of them are independent, so that the mean is known to a third of a scatter.
        assert abs(np.median(error)) < bar, name
        assert np.median(np.abs(error)) < 1.5 * bar, name


@pytest.mark.parametrize("times", [(0.0, 1.0, 4.0), (-3.0, 0.0, 1.2), (0.0, 3.0, 6.0)])
def test_the_search_counts_motion_in_nominal_intervals(
    device: Callable[[str], Device], times: tuple[float, ...]
) -> None:
    px = 4.0
    field = images((-3.0, 0.0, 1.0), px)  # any texture; what moves is made of it
    texture, shape = field[0, 0, 2], (100, 130)

    def image(t: int, sy: int, sx: int) -> np.ndarray:
        by = round(px * (times[t] - times[1]))
        return texture[:100, 20 - by : 150 - by]

    found = coarse_search(
        device("f32"), image, Extent(3, 1, 1, *shape, times=times), reference=(0, 0), frame=1, motion_range=8.0
    )
    inner = np.s_[15:-15, 30:-30]
    assert found.known[inner].mean() > 0.95
    np.testing.assert_allclose(np.median(found.motion[:, 15:-15, 30:-30], axis=(1, 2)), [px, 0.0], atol=0.25)
    assert (np.abs(found.motion[0][inner] - px) < 0.5).mean() > 0.95


def test_only_frames_about_as_far_are_compared() -> None:
    extent = Extent(4, 1, 1, 10, 10, times=(0.0, 1.0, 4.0, 5.2))
    assert extent.neighbours(0) == {1: 1.0}
    assert extent.neighbours(1) == {0: -1.0}
    assert extent.neighbours(2) == {3: pytest.approx(1.2)}
    assert Extent(4, 1, 1, 10, 10).neighbours(1) == {2: 1.0, 0: -1.0}


def test_what_is_seen_later_has_moved_and_hides_what_is_farther() -> None:
    """A near square moves by 6 px to the right per interval over a still ground: half an interval later."""
    disparity, motion = np.full((12, 30), -2.0, np.float32), np.zeros((2, 12, 30), np.float32)
    near = np.s_[4:8, 10:16]
    disparity[near], motion[0][near] = -9.0, 6.0
    known = np.ones((12, 30), bool)
    known[0, 0] = False
    later = Coarse(disparity, motion, known).later(0.5, -1.0)
    wanted = np.full((12, 30), -2.0)
    wanted[4:8, 13:19] = -9.0
    lit = np.zeros((12, 30), bool)
    lit[4:8, 10:13] = True
    np.testing.assert_array_equal(later.disparity[~lit], wanted[~lit])
    np.testing.assert_array_equal(later.motion[0][~lit], np.where(wanted == -9.0, 6.0, 0.0)[~lit])
    np.testing.assert_array_equal(later.known, known & ~lit)
    # What grows leaves no gaps.
    spread = np.zeros((2, 12, 30), np.float32)
    spread[0] = 0.4 * (np.arange(30) - 15)
    grown = Coarse(disparity * 0, spread, np.ones((12, 30), bool)).later(1.0, 1.0)
    assert grown.known.all()
    np.testing.assert_allclose(grown.motion[0], np.tile(0.4 / 1.4 * (np.arange(30) - 15), (12, 1)), atol=0.4)
