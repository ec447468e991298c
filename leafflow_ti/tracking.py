"""Material points followed through all frames of a results store.

A point moves in the image as the flow maps say, ``dx/dt = u(x, t)``, and lies in space where the depth map of each
frame has it: only its way in the image is integrated. From frame to frame (h apart, the one before h' earlier)

    x(t + h) = x(t) + ∫ u,   u the parabola through the motions at t - h', t and t + h        (Adams-Moulton)

of third order. It is implicit, solved by fixed-point steps. Each step needs the maps of one more frame, and the motion
that the point had in the two before. The first one is that of the trapezoid, corrected when the third motion is known.

Frames of results that lie half way between two images (``time_offset``) are as far from each other: tracks lie there,
too. Positions are those of the reference camera: X right, Y down, Z away from it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from leafflow_ti.drift import bent, closure, noise
from leafflow_ti.errors import InputError, UsageError
from leafflow_ti.interpolation import Reading
from leafflow_ti.point_maps import PointMaps, Samples
from leafflow_ti.tracks import Tracks as Tracks
from leafflow_ti.tracks import TrackStatus as TrackStatus

if TYPE_CHECKING:
    from leafflow_ti.results import ResultStore

Floats = NDArray[np.float64]

MAX_DRIFT = 1.0
"""Drift [px] beyond which a point is given up, unless stated."""
ROUNDS = 3
"""Fixed-point steps of a time step. Each one gains the factor of the flow's gradient, which is below .1 in any sequence
that can be measured; the prediction is off by a fraction of the change of motion between two frames."""


def track(
    store: ResultStore, x: ArrayLike, y: ArrayLike, start: int | None = None, *, max_drift: float = MAX_DRIFT
) -> Tracks:
    """Follow the points ``x``, ``y`` [n] px of frame ``start`` (default: the store's first) through all its frames.

    Ahead and back in time from ``start``; a point is lost where it leaves what is measured, comes to an edge between
    surfaces, or its drift exceeds ``max_drift`` px. The values of a coarse search are not followed.
    Raises InputError for a store without motion or with gaps between its frames, UsageError for arguments that make no
    sense.
    """
    x, y = (np.atleast_1d(np.asarray(values, np.float64)) for values in (x, y))
    if x.ndim != 1 or x.shape != y.shape or not np.isfinite([x, y]).all():
        raise UsageError(f"points have x of shape {x.shape}, y of {y.shape}: give as many finite x as y, in one row")
    if not max_drift > 0:
        raise UsageError(f"max_drift = {max_drift:g} px: must be positive")
    frames = np.array(store.frames, np.int64)
    gaps = np.flatnonzero(np.diff(frames) != 1)
    if gaps.size:
        before, behind = frames[gaps[0]], frames[gaps[0] + 1]
        raise InputError(
            f"{store.path}: no results between the frames {before} and {behind}: points cannot be followed over a gap; "
            "run all frames from the first to the last"
        )
    start = int(frames[0] if start is None else start)
    if start not in store.frames:
        raise UsageError(f"start = {start}: the store holds the frames {frames[0]}..{frames[-1]}: choose one of them")
    maps = PointMaps.of(store)
    at = store.frames.index(start)
    times = clock(store)
    first = np.array([x, y])
    ahead = _Way.along(maps, first, range(at, len(frames)), times, max_drift)
    back = _Way.along(maps, first, range(at, -1, -1), times, max_drift)
    joined = [np.concatenate([b[:0:-1], a]) for a, b in zip(ahead.arrays, back.arrays, strict=True)]
    at_px, depth, drift, ends_apart = joined
    return Tracks(
        frames, store.times_s, start, at_px[:, 0], at_px[:, 1], maps.in_space(at_px, depth), drift, ends_apart,
        ahead.status, back.status,
    )  # fmt: skip


def clock(store: ResultStore) -> Floats:
    """When the results of each frame are, [T] in intervals between frames, the unit of the motion's time."""
    times, interval = store.times_s, store.interval_s
    return np.array(store.frames, float) if times is None or interval is None else times / interval


@dataclass(frozen=True, eq=False)
class _Way:
    """Points followed in one direction, S frames: ``at`` [S, 2, n] px, ``depth`` [S, n] mm, ``drift`` and ``closure``
    [S, n] px, ``status`` [n]."""

    at: Floats
    depth: Floats
    drift: Floats
    closure: Floats
    status: NDArray[np.uint8]

    @property
    def arrays(self) -> tuple[Floats, ...]:
        """All that has a row for each frame."""
        return self.at, self.depth, self.drift, self.closure

    @classmethod
    def along(cls, maps: PointMaps, first: Floats, order: Iterable[int], clock: Floats, max_drift: float) -> _Way:
        """From the points ``first`` [2, n] of the first of the frames with the indices ``order``."""
        order = list(order)
        samples, at, status = _followed(maps, first, order, clock)
        motion, std, acceleration, bend = (
            np.array([getattr(s, name) for s in samples]) for name in ("motion", "std", "acceleration", "bend")
        )
        steps = np.diff(clock[order])
        apart = closure(motion, acceleration, steps)
        drift = noise(std, maps.noise.t, steps) + 0.5 * apart + bent(bend, steps)
        with np.errstate(invalid="ignore"):
            lost = np.logical_or.accumulate(drift > max_drift, axis=0)
        status[lost.any(axis=0)] = TrackStatus.DRIFTED
        depth = np.array([s.depth for s in samples])
        for values in (depth, drift, apart):
            values[lost] = np.nan
        at[np.broadcast_to(lost[:, None], at.shape)] = np.nan
        return cls(at, depth, drift, apart, status)


def _followed(
    maps: PointMaps, first: Floats, order: list[int], clock: Floats
) -> tuple[list[Samples], Floats, NDArray[np.uint8]]:
    """What the points find in every frame, where they are [S, 2, n], and why they were lost [n]."""
    frame = maps.frame(order[0])
    status = frame.reading(first)
    samples = [frame.samples(first).where(status == Reading.OK)]
    at = np.full((len(order), *first.shape), np.nan)
    at[0] = first
    for k, index in enumerate(order[1:], start=1):
        frame = maps.frame(index)
        step = clock[index] - clock[order[k - 1]]
        before = None if k == 1 else (samples[k - 2].motion, clock[order[k - 1]] - clock[order[k - 2]])
        now = samples[-1].motion
        behind, here, ahead = _weights(step, None if before is None else before[1])
        known = here * now + (0.0 if before is None else behind * before[0])
        guess = now if before is None else now + 0.5 * step / before[1] * (now - before[0])
        place = at[k - 1] + step * guess
        for _ in range(ROUNDS):
            better = at[k - 1] + known + ahead * frame.motion(place)
            place = np.where(np.isfinite(better), better, place)  # where nothing is measured, that is the reason
        found = frame.reading(place)
        status = np.where(status == Reading.OK, found, status)
        alive = status == Reading.OK
        at[k] = np.where(alive, place, np.nan)
        samples.append(frame.samples(place).where(alive))
        if k == 2:
            back = _weights(clock[order[0]] - clock[order[1]], clock[order[1]] - clock[order[2]])
            way = sum(w * samples[i].motion for w, i in zip(back, (2, 1, 0), strict=True))
            at[1:3] += np.where(alive, first - way - at[1], 0.0)
    return samples, at, status


def _weights(step: float, before: float | None) -> tuple[float, float, float]:
    """Weights of the motions one frame before, now, and one frame on, in the way over the time ``step``.

    ``before``: time between the first two (signed as ``step``); None: there is no frame before.
    """
    if before is None:
        return 0.0, step / 2, step / 2
    return (
        -(step**3) / (6 * before * (before + step)),
        step * (step + 3 * before) / (6 * before),
        step * (2 * step + 3 * before) / (6 * (before + step)),
    )
