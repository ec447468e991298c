"""Leaf-fixed coordinates: where points lie along and across an axis of the leaf, such as its midrib.

The axis is a curve on the surface in the frame in which the points were given: a polyline in the image, lifted onto the
surface at every output pixel that it passes, or the longest principal axis of the points in space. ``along`` [mm] is
the length of the curve to the foot of a point, from where it begins; beyond its ends it goes straight on. ``across``
[mm] is the straight distance from the foot, positive to the right of who looks along the axis in the image.

The axis in the tangents of the surface turns the strain since the start into that along and across it.
"""

from __future__ import annotations

import itertools
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from leafflow_ti.errors import InputError, UsageError
from leafflow_ti.interpolation import Reading
from leafflow_ti.point_maps import PointMaps
from leafflow_ti.tracks import Tracks

if TYPE_CHECKING:
    from leafflow_ti.results import ResultStore

Floats = NDArray[np.float64]

AUTO = "auto"
LEAST_POINTS = 3
"""Points of a label with which its principal axis is told."""
AXIS_STRAINS = ("strain_along", "strain_across", "strain_shear")


def leaf_coordinates(store: ResultStore, tracks: Tracks, axis: ArrayLike | str = AUTO) -> Tracks:
    """The tracks with ``along`` and ``across`` [n] mm at the start and, if they have a strain, ``AXIS_STRAINS`` [T, n].

    ``axis``: positions (x, y) px of two or more points on it [k, 2] in the frame of the start, or "auto": the longest
    principal axis of the points in space, of each label apart where they have a ``label``; it runs to the right in the
    image or, if it is steeper, upwards.
    Raises UsageError for an axis that makes no sense, InputError where there is no depth along it.
    """
    place = tracks.position[tracks.start_index]
    if not np.isfinite(place).any():
        raise InputError("these results have no depth, so no lengths on a leaf: measure a camera grid")
    along, across = np.full((2, tracks.n_points), np.nan)
    direction = np.full(place.shape, np.nan)
    for members, curve in _curves(store, tracks, axis):
        along[members], across[members], direction[members] = foot(curve, place[members])
    found = {"along": along, "across": across}
    if "strain_11" in tracks.variables:
        found |= _turned(tracks, direction)
    return tracks.having(found)


def _curves(store: ResultStore, tracks: Tracks, axis: ArrayLike | str) -> list[tuple[NDArray[np.bool_], Floats]]:
    """Which points [n] belong to which axis, a polyline [k, 3] mm."""
    everyone = np.ones(tracks.n_points, np.bool_)
    if not isinstance(axis, str):
        return [(everyone, _on_surface(store, tracks.start_index, _polyline(axis)))]
    if axis != AUTO:
        raise UsageError(f"axis '{axis}': give positions of two or more points, or {AUTO}")
    label = tracks.variables.get("label", everyone)
    place = tracks.position[tracks.start_index]
    groups = [(label == value) & np.isfinite(place[:, 2]) for value in np.unique(label)]
    return [(members, principal_axis(place[members])) for members in groups if members.sum() >= LEAST_POINTS]


def _polyline(axis: ArrayLike) -> Floats:
    corners = np.asarray(axis, np.float64)
    if corners.ndim != 2 or corners.shape[1] != 2 or len(corners) < 2 or not np.isfinite(corners).all():
        raise UsageError(f"an axis of shape {corners.shape}: give the positions x, y of two or more points")
    if (np.diff(corners, axis=0) == 0).all(axis=1).any():
        raise UsageError("two neighbouring points of the axis are the same: leave one out")
    return corners


def _on_surface(store: ResultStore, index: int, corners: Floats) -> Floats:
    """The polyline [k, 2] px as a curve [m, 3] mm on the surface; it spans straight what is not measured."""
    maps = PointMaps.of(store)
    pitch = min(maps.lattice.step)
    parts = []
    for one, two in itertools.pairwise(corners):
        count = max(1, round(float(np.hypot(*(two - one))) / pitch))
        parts.append(one + np.arange(count)[:, None] / count * (two - one))
    at = np.concatenate([*parts, corners[-1:]]).T
    frame = maps.frame(index)
    at = at[:, frame.reading(at) == Reading.OK]
    if at.shape[1] < 2:
        raise InputError(
            f"the axis passes {at.shape[1]} of the measured pixels in frame {store.frames[index]}: lay it on the leaf"
        )
    return maps.in_space(at, frame.samples(at).depth)


def principal_axis(points: Floats) -> Floats:
    """The longest principal axis [2, 3] of points [n, 3], from the first to the last of them along it."""
    centre = points.mean(axis=0)
    direction = np.linalg.svd(points - centre, full_matrices=False)[2][0]
    x, y = direction[:2]
    if (x if abs(x) >= abs(y) else -y) < 0:
        direction = -direction
    reach = (points - centre) @ direction
    return np.asarray(centre + np.array([[reach.min()], [reach.max()]]) * direction)


def foot(curve: Floats, points: Floats) -> tuple[Floats, Floats, Floats]:
    """Length along the polyline ``curve`` [m, 3], signed distance from it, and its direction [n, 3] at the feet of
    points [n, 3]; NaN for points that are not known."""
    step = np.diff(curve, axis=0)
    length = np.linalg.norm(step, axis=1)
    begin = np.concatenate([[0.0], np.cumsum(length)])
    best, along, across = (np.full(len(points), v) for v in (np.inf, np.nan, np.nan))
    direction = np.full(points.shape, np.nan)
    for k, (start, unit) in enumerate(zip(curve, step / length[:, None], strict=False)):
        away = points - start
        way = away @ unit
        way = np.clip(way, -np.inf if k == 0 else 0.0, np.inf if k == len(step) - 1 else length[k])
        off = away - way[:, None] * unit
        distance = np.linalg.norm(off, axis=1)
        nearer = distance < best  # NaN is not
        side = np.cross(unit, off)[nearer]
        best[nearer], along[nearer] = distance[nearer], begin[k] + way[nearer]
        across[nearer] = np.copysign(distance[nearer], np.einsum("ni,ni->n", side, points[nearer]))
        direction[nearer] = unit
    return along, across, direction


def _turned(tracks: Tracks, direction: Floats) -> dict[str, Floats]:
    """Strains since the start along and across the directions [n, 3], and the shear between them."""
    x, y = np.moveaxis(np.einsum("nik,ni->nk", tracks.variables["tangents"], direction), -1, 0)
    size = np.hypot(x, y)
    c, s = x / size, y / size
    one, two, both = (tracks.variables[name] for name in ("strain_11", "strain_22", "strain_12"))
    values = (
        c**2 * one + s**2 * two + 2 * s * c * both,
        s**2 * one + c**2 * two - 2 * s * c * both,
        s * c * (two - one) + (c**2 - s**2) * both,
    )
    return dict(zip(AXIS_STRAINS, values, strict=True))
