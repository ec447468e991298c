"""What of a capture may spoil its results without stopping a run: each doubt is a line that names files and a way out.

Looked at are the middle rows of some images: those of all cameras in ``FRAMES`` frames, and those of the reference
camera in up to ``MOST_FRAMES`` pairs of successive frames. What these rows show is confirmed on the whole images before
it is said.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from leafflow_ti.capture.capture import Capture
from leafflow_ti.capture.channels import Array
from leafflow_ti.capture.order import order_doubts
from leafflow_ti.capture.plausibility import plausibility
from leafflow_ti.errors import InputError

ROWS = 16
FRAMES = 3
"""Frames of which all cameras are looked at; one where a file must be decoded whole for a few of its rows."""
MOST_FRAMES, MOST_DECODED = 2000, 100
"""Frames of the reference camera; of such files."""
LIGHT_STEP = 0.15
"""Change of the mean grey value between two frames, relative. Measured on a plane with one darker frame: with 10 % nine
tenths of the values keep their error bars, with 20 % those of the flow models do not, with 30 % most have none."""
CAMERA_FACTOR = 2.0
"""Grey values of one camera against those of the others: matched windows no longer look alike."""
MOST_BAD = 0.5
"""Share of the pixels of an image that may be saturated, or no numbers."""
FEWEST_BITS = 4
"""Grey values of fewer bits are masks or dithered: their largest one does not mean too much light."""
CONFIRMED = 16
"""Most findings of a kind that are confirmed on whole images: from there on they are not counted."""
_SHOWN = 3

_Key = tuple[int, int, int]  # frame, camera row, camera column


@dataclass(frozen=True)
class _Glance:
    """Of the middle rows of an image: mean grey value, lowest and highest, shares, checksum."""

    mean: float
    low: float
    high: float
    saturated: float
    unknown: float
    digest: bytes


def capture_doubts(capture: Capture) -> tuple[str, ...]:
    """Doubts about the calibration, the order of the cameras, and the images that are looked at.

    Images that cannot be read are passed over: whoever needs them says so.
    """
    glances = {key: found for key in _looked_at(capture) if (found := _glance(capture, key, *_middle(capture)))}
    return (
        *plausibility(capture),
        *_empty(capture, glances),
        *_identical(capture, glances),
        *_of_cameras(capture, glances),
        *_of_frames(capture, glances),
        *order_doubts(capture),
    )


def _looked_at(capture: Capture) -> list[_Key]:
    every = FRAMES if capture.reads_windows else 1
    frames = {capture.n_frames // 2, *_spread(capture.n_frames, every)} if every > 1 else {capture.n_frames // 2}
    keys = {(t, row, col) for t in frames for row in range(capture.n_rows) for col in range(capture.n_cols)}
    most = MOST_FRAMES if capture.reads_windows else MOST_DECODED
    if capture.n_frames <= most:
        keys |= {(t, *capture.reference) for t in range(capture.n_frames)}
    else:
        starts = _spread(capture.n_frames - 1, most // 2)
        keys |= {(t + k, *capture.reference) for t in starts for k in (0, 1)}
    return sorted(keys)


def _spread(count: int, wanted: int) -> list[int]:
    return sorted({round(k) for k in np.linspace(0, count - 1, min(count, wanted))})


def _middle(capture: Capture) -> tuple[int, int]:
    rows = min(ROWS, capture.height)
    top = (capture.height - rows) // 2
    return top, top + rows


def _whole(capture: Capture) -> tuple[int, int]:
    return 0, capture.height


def _read(capture: Capture, key: _Key, y0: int, y1: int) -> Array | None:
    try:
        return capture.stored_rows(*key, y0, y1)
    except InputError:
        return None


def _glance(capture: Capture, key: _Key, y0: int, y1: int) -> _Glance | None:
    values = _read(capture, key, y0, y1)
    if values is None:
        return None
    known = values[np.isfinite(values)] if values.dtype.kind == "f" else values
    if not known.size:
        return _Glance(math.nan, math.nan, math.nan, 0.0, 1.0, b"")
    countable = capture.dtype.kind in "ui" and capture.bits >= FEWEST_BITS
    return _Glance(
        float(known.mean(dtype=np.float64)),
        float(known.min()),
        float(known.max()),
        float(np.mean(known >= 2.0**capture.bits - 1)) if countable else 0.0,
        1 - known.size / values.size,
        hashlib.sha256(np.ascontiguousarray(values).data).digest(),
    )


def _confirmed(capture: Capture, keys: Iterable[_Key]) -> Iterator[tuple[_Key, _Glance]]:
    """The same of whole images."""
    for key in list(keys)[:CONFIRMED]:
        found = _glance(capture, key, *_whole(capture))
        if found is not None:
            yield key, found


def _names(capture: Capture, keys: list[_Key]) -> str:
    rest = "others" if len(keys) >= CONFIRMED else f"{len(keys) - _SHOWN} more"
    more = f" and {rest}" if len(keys) > _SHOWN else ""
    return ", ".join(capture.image_name(*key) for key in keys[:_SHOWN]) + more


def _empty(capture: Capture, glances: dict[_Key, _Glance]) -> Iterator[str]:
    """Constant images, and those that are saturated or no numbers for the most part."""
    odd = [k for k, g in glances.items() if not g.low < g.high or max(g.saturated, g.unknown) > MOST_BAD]
    whole = dict(_confirmed(capture, odd))
    none = [k for k, g in whole.items() if g.unknown > MOST_BAD]
    if none:
        yield f"{_names(capture, none)}: more than half of the grey values are no numbers: nothing is measured there"
    constant = [k for k, g in whole.items() if g.low == g.high and k not in none]
    if constant:
        level = whole[constant[0]].low
        yield (
            f"{_names(capture, constant)}: every pixel is {level:g}{' (black)' if level == 0 else ''}: nothing is "
            "measured there; was the light off, or the shutter closed?"
        )
    bright = [k for k, g in whole.items() if g.saturated > MOST_BAD and k not in constant]
    if bright:
        share = max(whole[k].saturated for k in bright)
        yield f"{_names(capture, bright)}: up to {share:.0%} of the pixels are saturated: lower the exposure"


def _identical(capture: Capture, glances: dict[_Key, _Glance]) -> Iterator[str]:
    """Two images with the same noise are one image: a copy under another name."""
    first: dict[bytes, _Key] = {}
    pairs = []
    for key, glance in glances.items():
        if glance.low < glance.high and first.setdefault(glance.digest, key) != key:
            pairs.append((first[glance.digest], key))
    same = [pair for pair in pairs[:CONFIRMED] if _same(capture, *pair)]
    if same:
        one, other = (capture.image_name(*key) for key in same[0])
        more = f" (and {len(same) - 1} more pairs)" if len(same) > 1 else ""
        yield f"{one} and {other} are identical{more}, which no two exposures are: was one copied over the other?"


def _same(capture: Capture, one: _Key, other: _Key) -> bool:
    a, b = (_read(capture, key, *_whole(capture)) for key in (one, other))
    return a is not None and b is not None and np.array_equal(a, b, equal_nan=a.dtype.kind == "f")


def _of_cameras(capture: Capture, glances: dict[_Key, _Glance]) -> Iterator[str]:
    """Cameras much darker or brighter than the others, in the middle frame."""
    t = capture.n_frames // 2
    means = {key: g.mean for key, g in glances.items() if key[0] == t}
    if len(means) < 3:
        return
    odd = [key for key in means if _differs(means[key], float(np.median(list(means.values()))), CAMERA_FACTOR)]
    if not odd:
        return
    others = [g.mean for _, g in _confirmed(capture, (key for key in means if key not in odd))]
    usual = float(np.median(others)) if others else math.nan
    for (_, row, col), found in _confirmed(capture, odd):
        if found.low < found.high and _differs(found.mean, usual, CAMERA_FACTOR):
            yield (
                f"camera (row {row}, column {col}) shows {found.mean / usual:.2g} times the grey values of the others "
                f"in frame {t}: windows that hold it give no result or a wrong one; check its aperture and exposure"
            )


def _of_frames(capture: Capture, glances: dict[_Key, _Glance]) -> Iterator[str]:
    """Abrupt changes of the light between successive frames."""
    means = {t: g.mean for (t, row, col), g in glances.items() if (row, col) == capture.reference}
    factor = 1 / (1 - LIGHT_STEP)
    odd = [t for t in means if t + 1 in means and _differs(means[t + 1], means[t], factor)]
    whole = {
        key[0]: g.mean for key, g in _confirmed(capture, [(t + k, *capture.reference) for t in odd for k in (0, 1)])
    }
    steps = [t for t in odd if t + 1 in whole and t in whole and _differs(whole[t + 1], whole[t], factor)]
    if steps:
        said = [f"frame {t + 1} has {whole[t + 1] / whole[t]:.2g} times the grey values of frame {t}" if whole[t] else
                f"frame {t} is black" for t in steps[:_SHOWN]]  # fmt: skip
        more = f" (and {len(steps) - _SHOWN} more)" if len(steps) > _SHOWN else ""
        yield (
            f"the light changes abruptly: {', '.join(said)}{more}: windows that hold such a change give no result or a "
            "wrong one; use --brightness temporal for small changes, and leave out frames without light (--frames)"
        )


def _differs(value: float, usual: float, factor: float) -> bool:
    """Whether two grey values differ by more than a factor; never where one is not a number."""
    return value > factor * usual or usual > factor * value
