"""Quick looks: PNG pictures of one frame of a results store, to see at a glance what was measured.

Pictures are in pixel coordinates of the reference image (x right, y down) with equal scales; colour limits are the 2nd
and 98th percentile; colour maps are perceptually uniform, diverging about zero where a map has both signs. Hatched
areas have no value. Normals are coded as (red, green, blue) = (n + 1) / 2 with n = (ZX, ZY, 1) / |.|, the unit normal
of the surface that faces the camera, its third component counted towards the camera.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.errors import MissingExtra, RunError
from leafflow_ti.field import PLANE_STRAIN_NAMES, STRAIN_NAMES, Field, quantity
from leafflow_ti.results import ResultStore
from leafflow_ti.status import Status

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage

STATUS_COLOURS: dict[Status, str] = {
    Status.OK: "#5aa469",
    Status.NO_STRUCTURE: "#4c5b70",
    Status.APERTURE: "#f0c75e",
    Status.INCOHERENT: "#c4553d",
    Status.NOT_CONVERGED: "#8a3f7f",
    Status.BORDER: "#c3d0dc",
    Status.MASKED: "#1f1f24",
    Status.NOT_FINITE: "#e88fb0",
    Status.UNREFINED: "#5b9bd0",
    Status.CONTESTED: "#c9a86a",
    Status.COARSE: "#9fc3a8",
    Status.NOT_COMPUTED: "#f7f7f7",
}
"""Colour of each status in the pictures."""

SIGNED = ("growth_rate", *STRAIN_NAMES)
"""Maps whose colours diverge about zero even where all values have one sign."""

_DPI = 120
_IMAGE_INCHES = 3.1
_LEFT_INCHES, _RIGHT_INCHES, _ABOVE_INCHES, _BELOW_INCHES = 0.65, 1.35, 0.35, 0.5
"""Width of an image, and the room for labels, colour bar and title around it."""
_ARROWS = 18
"""Arrows along the longer side of a motion map."""

_Panel = Callable[["Axes"], None]


def write_quicklooks(store: ResultStore, t_index: int, folder: str | Path) -> list[Path]:
    """Write the pictures of the frame with index ``t_index`` along t into ``folder``; return their paths.

    ``overview.png`` and ``status.png`` always; ``depth.png``, ``normals.png``, ``motion.png``, ``rotation.png``,
    ``flow.png`` and ``growth.png`` where the store has their maps. Raises MissingExtra where matplotlib is not
    installed, RunError when the folder cannot be written.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise MissingExtra("matplotlib", "plot", "writing quick looks") from None
    field, folder = store.field(t_index), Path(folder)
    written = []
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, panels in _pages(field).items():
            figure = Figure()
            _lay_out(figure, field, panels, f"{store.path.name} · frame {field.frame} · {name}")
            path = folder / f"{name}.png"
            figure.savefig(path, dpi=_DPI, facecolor="white", metadata={"Software": None})
            written.append(path)
    except OSError as error:
        raise RunError(f"{folder}: quick looks cannot be written ({error.strerror}): see --no-quicklook") from error
    return written


def normal_colours(slope_x: NDArray[np.floating], slope_y: NDArray[np.floating]) -> NDArray[np.float64]:
    """Colours [y, x, 3] in 0..1 of the unit normals of a surface with the slopes ZX, ZY [y, x]; NaN where these are."""
    normal = np.stack([slope_x, slope_y, np.ones_like(slope_x)], axis=-1).astype(np.float64)
    return np.asarray((normal / np.linalg.norm(normal, axis=-1, keepdims=True) + 1) / 2)


def robust_limits(values: NDArray[np.floating]) -> tuple[float, float]:
    """2nd and 98th percentile of the finite values, kept apart; symmetric about 0 when the signs differ."""
    finite = values[np.isfinite(values)]
    low, high = (float(v) for v in np.percentile(finite, (2, 98))) if finite.size else (0.0, 1.0)
    if low < 0 < high:
        high = max(-low, high)
        return (-high, high)
    if high - low <= 1e-6 * max(abs(low), abs(high)):  # a constant map: show it in the middle of the colours
        margin = 1e-3 * abs(high) or 1.0
        return (low - margin, high + margin)
    return (low, high)


def _pages(field: Field) -> dict[str, list[_Panel]]:
    """The panels of each picture, for the maps that the field has."""
    pages: dict[str, list[_Panel]] = {}
    overview: list[_Panel] = []
    distance = next((name for name in ("depth", "disparity") if name in field), None)
    if distance is not None:
        pages["depth"] = _maps(field, [distance, f"{distance}_std"])
        overview += pages["depth"][:1]
    if "slope_x" in field and "slope_y" in field:
        pages["normals"] = [partial(_draw_normals, field), *_maps(field, ["slope_x", "slope_y"])]
        overview += pages["normals"][:1]
    overview.append(partial(_draw_status, field))
    for page, base in (("motion", "velocity"), ("rotation", "rotation"), ("flow", "flow")):
        panels = _maps(field, [f"{base}_{axis}" for axis in "xyz"])
        if not panels:
            continue
        overview += panels
        pages[page] = panels
        if base != "rotation" and f"{base}_x" in field and f"{base}_y" in field:
            pages[page] = [*panels, partial(_draw_arrows, field, base)]
    strain = _maps(field, PLANE_STRAIN_NAMES)
    if strain:
        pages["strain"] = strain
        overview += strain
    if "growth_rate" in field:
        pages["growth"] = _maps(field, ["growth_rate", "growth_rate_std", *STRAIN_NAMES])
        overview += pages["growth"][:1]
    return {**pages, "status": [partial(_draw_status, field)], "overview": overview}


def _maps(field: Field, names: Sequence[str]) -> list[_Panel]:
    return [partial(_draw_map, field, name) for name in names if name in field]


def _lay_out(figure: Figure, field: Field, panels: Sequence[_Panel], title: str) -> None:
    """Panels in up to three columns (four panels: two), each as high as the image's proportions ask for."""
    columns = 2 if len(panels) == 4 else min(3, len(panels))
    rows = math.ceil(len(panels) / columns)
    (left, right), (top, bottom) = _span(field.x), _span(field.y)
    height = _IMAGE_INCHES * min(max((bottom - top) / (right - left), 0.25), 2.5)
    pitch_x = _LEFT_INCHES + _IMAGE_INCHES + _RIGHT_INCHES
    pitch_y = _ABOVE_INCHES + height + _BELOW_INCHES
    width, total = columns * pitch_x, rows * pitch_y + 0.4
    figure.set_size_inches(width, total)
    figure.suptitle(title, fontsize=12, y=1 - 0.12 / total, va="top")
    for number, draw in enumerate(panels):
        row, column = divmod(number, columns)
        x, y = column * pitch_x + _LEFT_INCHES, (rows - 1 - row) * pitch_y + _BELOW_INCHES
        draw(figure.add_axes((x / width, y / total, _IMAGE_INCHES / width, height / total)))


def _span(positions: NDArray[np.int64]) -> tuple[float, float]:
    """Outer edges of the first and last pixel, or block of a stride."""
    step = float(positions[1] - positions[0]) if positions.size > 1 else 1.0
    return (float(positions[0]) - step / 2, float(positions[-1]) + step / 2)


def _image(axes: Axes, field: Field, values: NDArray[np.floating], **options: Any) -> AxesImage:
    """``values`` on hatched ground, pixel axes; NaN shows the ground."""
    axes.patch.set(facecolor="white", edgecolor="#c9c9c9", hatch="////", linewidth=0)
    axes.tick_params(labelsize=8)
    axes.set_xlabel("x [px]", fontsize=8)
    axes.set_ylabel("y [px]", fontsize=8)
    return axes.imshow(values, extent=(*_span(field.x), *_span(field.y)[::-1]), aspect="equal", **options)


def _draw_map(field: Field, name: str, axes: Axes) -> None:
    low, high = robust_limits(field[name])
    if name in SIGNED:
        high = max(-low, high)
        low = -high
    colours = "coolwarm" if low < 0 < high else "cividis" if name.endswith("_std") else "viridis"
    image = _image(axes, field, field[name], cmap=colours, vmin=low, vmax=high)
    unit, long_name = quantity(name)
    axes.set_title(
        name.removesuffix("_std").replace("_", " ") + ", standard error" * name.endswith("_std"), fontsize=10
    )
    _colour_bar(axes, image, f"{long_name} [{unit}]" if len(long_name) < 24 else f"[{unit}]")


def _colour_bar(axes: Axes, image: AxesImage, label: str) -> None:
    from matplotlib.ticker import ScalarFormatter

    numbers = ScalarFormatter()
    numbers.set_powerlimits((-3, 4))
    beside = axes.inset_axes((1.03, 0, 0.04, 1))
    bar = axes.figure.colorbar(image, cax=beside, extend="both", extendfrac=0.03, format=numbers)
    bar.set_label(label, fontsize=8)
    beside.tick_params(labelsize=8)
    beside.yaxis.get_offset_text().set_fontsize(8)


def _draw_normals(field: Field, axes: Axes) -> None:
    colours = normal_colours(field["slope_x"], field["slope_y"])
    opaque = np.isfinite(colours).all(axis=-1, keepdims=True)
    _image(axes, field, np.concatenate([np.where(opaque, colours, 0), opaque], axis=-1))
    axes.set_title("surface normals", fontsize=10)
    legend = axes.inset_axes((1.04, 0.3, 0.3, 0.4))
    across = np.linspace(-1, 1, 121)
    n_x, n_y = np.meshgrid(across, across)
    n_z = np.sqrt(np.clip(1 - n_x**2 - n_y**2, 0, None))
    disc = np.stack([(n_x + 1) / 2, (n_y + 1) / 2, (n_z + 1) / 2, (n_x**2 + n_y**2 <= 1).astype(float)], axis=-1)
    legend.imshow(disc, extent=(-1, 1, 1, -1), interpolation="bilinear")
    angles = np.linspace(0, 2 * np.pi, 181)
    for tilt in (30, 60):
        radius = math.sin(math.radians(tilt))
        legend.plot(radius * np.cos(angles), radius * np.sin(angles), color="white", linewidth=0.7)
        legend.text(0, 0.97 * radius, f"{tilt}°", color="white", fontsize=6, ha="center", va="bottom")
    legend.set_title("faces", fontsize=8, pad=2)
    legend.set_axis_off()
    for x, y, word, ha, va in ((1.05, 0, "right", "left", "center"), (0, 1.05, "down", "center", "top")):
        legend.text(x, y, word, fontsize=7, ha=ha, va=va)


def _draw_arrows(field: Field, base: str, axes: Axes) -> None:
    """Arrows of the components in the image plane on a map of their length, thinned to about ``_ARROWS`` a side."""
    u, v = field[f"{base}_x"], field[f"{base}_y"]
    length = np.hypot(u, v)
    low, high = robust_limits(length)
    image = _image(axes, field, length, cmap="viridis", vmin=low, vmax=high)
    _colour_bar(axes, image, f"[{quantity(f'{base}_x')[0]}]")
    step = max(1, round(max(length.shape) / _ARROWS))
    thin = (slice(step // 2, None, step), slice(step // 2, None, step))
    columns, rows = np.meshgrid(field.x[thin[1]], field.y[thin[0]])
    shown = np.isfinite(length[thin])
    if shown.any():
        spacing = float(step * ((field.x[-1] - field.x[0]) / max(field.x.size - 1, 1) or 1.0))
        axes.quiver(
            columns[shown],
            rows[shown],
            u[thin][shown],
            v[thin][shown],
            angles="xy",
            scale_units="xy",
            scale=max(high, 1e-12) / (0.9 * spacing),
            color="white",
            edgecolor="black",
            linewidth=0.4,
            width=0.006,
        )
    axes.set_title(f"{base} in the image plane", fontsize=10)


def _draw_status(field: Field, axes: Axes) -> None:
    from matplotlib.colors import to_rgb
    from matplotlib.patches import Patch

    table = np.zeros((256, 3))
    for status, colour in STATUS_COLOURS.items():
        table[status] = to_rgb(colour)
    _image(axes, field, table[field.status], interpolation="nearest")
    axes.set_title("status", fontsize=10)
    patches = [
        Patch(facecolor=STATUS_COLOURS[Status[name.upper()]], edgecolor="#888888", label=f"{name} {share:.1%}")
        for name, share in field.status_shares().items()
    ]
    axes.legend(
        handles=patches,
        loc="upper left",
        bbox_to_anchor=(1.01, 1),
        fontsize=7,
        frameon=False,
        borderaxespad=0,
        handlelength=1.2,
    )
