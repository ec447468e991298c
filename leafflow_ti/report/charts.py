"""Charts as SVG: curves with bands over the frames, and bars. Colours are classes of the page's style sheet.

Texts are escaped. Sizes are in units of the drawing, which the page scales to its width.
"""

from __future__ import annotations

from collections.abc import Sequence
from html import escape

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.number_text import axis_labels, round_steps
from leafflow_ti.report.facts import Series

WIDTH, HEIGHT = 480, 264
LEFT, RIGHT, TOP, BOTTOM = 58, 12, 28, 44
"""Room around the curves, for the axes' numbers and names."""
COLOURS = 8
"""Colours of curves in the style sheet, ``s0`` .. ``s7``."""

Floats = NDArray[np.float64]


class _Axes:
    """Where values lie in the drawing."""

    def __init__(self, x: tuple[float, float], y: tuple[float, float]):
        self.x, self.y = _apart(*x), _apart(*y)

    def across(self, x: float) -> float:
        return round(LEFT + (x - self.x[0]) / (self.x[1] - self.x[0]) * (WIDTH - LEFT - RIGHT), 1)

    def up(self, y: float) -> float:
        return round(HEIGHT - BOTTOM - (y - self.y[0]) / (self.y[1] - self.y[0]) * (HEIGHT - TOP - BOTTOM), 1)

    def frame(self, x_label: str, y_label: str) -> list[str]:
        """Grid lines, numbers and names of both axes."""
        rows, columns = round_steps(*self.y, 5), round_steps(*self.x, 6, 1.0)  # whole frames
        right, base = WIDTH - RIGHT, HEIGHT - BOTTOM
        parts = []
        for y, text in zip(rows, axis_labels(rows), strict=True):
            kind = "zero" if y == 0 else "grid"
            parts.append(f'<line class="{kind}" x1="{LEFT}" x2="{right}" y1="{self.up(y)}" y2="{self.up(y)}"/>')
            parts.append(f'<text class="end" x="{LEFT - 7}" y="{self.up(y) + 4.5}">{text}</text>')
        for x, text in zip(columns, axis_labels(columns), strict=True):
            parts.append(f'<text class="mid" x="{self.across(x)}" y="{base + 18}">{text}</text>')
        parts.append(f'<text class="mid name" x="{(LEFT + right) / 2}" y="{HEIGHT - 6}">{escape(x_label)}</text>')
        # Above the axis: beside it, long numbers would run into the name.
        parts.append(f'<text class="name" x="{LEFT - 7}" y="13">{escape(y_label)}</text>')
        return parts


def curves(
    series: Sequence[Series],
    x_label: str,
    y_label: str,
    title: str,
    marks: Sequence[float],
    limits: tuple[float, float] | None = None,
) -> str:
    """Means over x with bands of one standard error; the pixels' spread behind it where one curve stands alone.

    ``marks``: where along x the frames of the page's slider are; ``limits``: of the axis upwards, else what is shown.
    """
    axes = _Axes(_span([s.x for s in series]), limits or _limits(series))
    parts = axes.frame(x_label, y_label)
    if len(series) == 1 and series[0].spread is not None:
        low, high = series[0].spread
        parts.append(_band(axes, series[0].x, low, high, "spread"))
    for i, s in enumerate(series):
        parts.append(_band(axes, s.x, s.mean - s.error, s.mean + s.error, f"band s{i % COLOURS}"))
    parts += [_curve(axes, s.x, s.mean, f"curve s{i % COLOURS}") for i, s in enumerate(series)]
    if len(marks) > 1:
        at = " ".join(str(axes.across(x)) for x in marks)
        parts.append(f'<line class="now" data-at="{at}" x1="0" x2="0" y1="{TOP}" y2="{HEIGHT - BOTTOM}"/>')
    return _svg(parts, title)


def stage_bars(seconds: Sequence[tuple[str, float, str]], title: str) -> str:
    """Horizontal bars: name, value, and the value in words."""
    pitch, name_width, value_width = 26, 92, 84
    most = max((value for _, value, _ in seconds), default=0.0) or 1.0
    parts = []
    for i, (name, value, text) in enumerate(seconds):
        y, width = i * pitch + 3, max(1.0, round((WIDTH - name_width - value_width) * value / most, 1))
        parts.append(f'<text class="end" x="{name_width - 8}" y="{y + 15}">{escape(name)}</text>')
        parts.append(f'<rect class="stage-bar" x="{name_width}" y="{y}" width="{width}" height="{pitch - 6}" rx="3"/>')
        parts.append(f'<text x="{name_width + width + 7}" y="{y + 15}">{escape(text)}</text>')
    return _svg(parts, title, len(seconds) * pitch + 2)


def _svg(parts: Sequence[str], title: str, height: float = HEIGHT) -> str:
    return (
        f'<svg class="chart" viewBox="0 0 {WIDTH} {height}" role="img" aria-label="{escape(title)}">'
        f"{''.join(parts)}</svg>"
    )


def _runs(known: NDArray[np.bool_]) -> list[slice]:
    """Stretches without a gap."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], known, [False]]).astype(int)))
    return [slice(int(a), int(b)) for a, b in edges.reshape(-1, 2)]


def _points(axes: _Axes, x: Floats, y: Floats) -> str:
    return " ".join(f"{axes.across(a)},{axes.up(b)}" for a, b in zip(x, y, strict=True))


def _band(axes: _Axes, x: Floats, low: Floats, high: Floats, kind: str) -> str:
    """The area between two curves; a single point gets an upright line, which a stroke makes visible."""
    parts = []
    for run in _runs(np.isfinite(low) & np.isfinite(high)):
        there, back = _points(axes, x[run], high[run]), _points(axes, x[run][::-1], low[run][::-1])
        parts.append(f'<polygon class="{kind}" points="{there} {back}"/>')
    return "".join(parts)


def _curve(axes: _Axes, x: Floats, y: Floats, kind: str) -> str:
    runs = _runs(np.isfinite(y))
    lines = "".join(f'<polyline class="{kind}" points="{_points(axes, x[run], y[run])}"/>' for run in runs)
    if sum(run.stop - run.start for run in runs) > 40:
        return lines
    dots = "".join(
        f'<circle class="{kind}" cx="{axes.across(a)}" cy="{axes.up(b)}" r="2.6"/>'
        for run in runs
        for a, b in zip(x[run], y[run], strict=True)
    )
    return lines + dots


def _span(arrays: Sequence[Floats]) -> tuple[float, float]:
    values = np.concatenate([np.ravel(a) for a in arrays])
    values = values[np.isfinite(values)]
    return (float(values.min()), float(values.max())) if values.size else (0.0, 1.0)


def _limits(series: Sequence[Series]) -> tuple[float, float]:
    """All bands, and a little more."""
    shown = [s.mean + sign * s.error for s in series for sign in (-1, 1)]
    if len(series) == 1 and series[0].spread is not None:
        shown.append(series[0].spread)
    low, high = _span(shown)
    margin = 0.06 * (high - low)
    return low - margin, high + margin


def _apart(low: float, high: float) -> tuple[float, float]:
    """The two, kept apart."""
    if high - low > 1e-9 * max(abs(low), abs(high)):
        return low, high
    margin = 0.5 * abs(high) or 1.0
    return low - margin, high + margin
