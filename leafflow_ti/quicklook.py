"""Quick looks: PNG pictures of one frame of a results store, to see at a glance what was measured.

Pictures are in pixel coordinates of the reference image (x right, y down) with equal scales. What is drawn is in
``panels``, its colours are in ``colours``; this module lays it out. Hatched areas have no value.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from leafflow_ti.colours import STATUS_COLOURS, Scale, normal_disc, normal_image, status_colours
from leafflow_ti.errors import MissingExtra, RunError
from leafflow_ti.field import Field
from leafflow_ti.panels import Panel, arrows_of, extent, panels_of
from leafflow_ti.results import ResultStore
from leafflow_ti.status import Status
from leafflow_ti.whole import appearing

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from matplotlib.image import AxesImage

_DPI = 120
_MOST_PIXELS = 1000
"""Output pixels along a side of an image: of a picture of some 370 more cannot be seen."""
_IMAGE_INCHES = 3.1
_LEFT_INCHES, _RIGHT_INCHES, _ABOVE_INCHES, _BELOW_INCHES = 0.65, 1.35, 0.35, 0.5
"""Width of an image, and the room for labels, colour bar and title around it."""


def write_quicklooks(store: ResultStore, t_index: int, folder: str | Path) -> list[Path]:
    """Write the pictures of the frame with index ``t_index`` along t into ``folder``; return their paths.

    One for each of ``panels.PAGES`` of which the store has maps, and ``overview.png``. Raises MissingExtra where
    matplotlib is not installed, RunError when the folder cannot be written.
    """
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise MissingExtra("matplotlib", "plot", "writing quick looks") from None
    pages, folder = panels_of(store.names, store.interval_s), Path(folder)
    field = _thinned(store, t_index, {name for panels in pages.values() for panel in panels for name in panel.needs})
    written = []
    for name, panels in pages.items():
        figure = Figure()
        _lay_out(figure, field, panels, f"{store.path.name} · frame {field.frame} · {name}")
        path = folder / f"{name}.png"
        try:
            with appearing(path) as scratch:
                figure.savefig(scratch, dpi=_DPI, facecolor="white", metadata={"Software": None})
        except RunError as error:
            raise RunError(f"quick looks cannot be written: {error}; --no-quicklook goes without") from error
        written.append(path)
    return written


def _thinned(store: ResultStore, t_index: int, names: Collection[str]) -> Field:
    """Some maps of one frame with no more pixels than pictures show: all maps of a large frame are much memory."""
    thin = -(-max(store.y.size, store.x.size) // _MOST_PIXELS)

    def read(name: str) -> NDArray[Any]:
        return store.read(name, t_index)[::thin, ::thin].copy()

    maps = {name: read(name) for name in store.names if name in names}
    return Field(maps, read("status"), store.y[::thin], store.x[::thin], store.frames[t_index], store.attrs)


def _lay_out(figure: Figure, field: Field, panels: Sequence[Panel], title: str) -> None:
    """Panels in up to three columns (four panels: two), each as high as the image's proportions ask for."""
    columns = 2 if len(panels) == 4 else min(3, len(panels))
    rows = math.ceil(len(panels) / columns)
    (left, right), (top, bottom) = extent(field.x), extent(field.y)
    height = _IMAGE_INCHES * min(max((bottom - top) / (right - left), 0.25), 2.5)
    pitch_x = _LEFT_INCHES + _IMAGE_INCHES + _RIGHT_INCHES
    pitch_y = _ABOVE_INCHES + height + _BELOW_INCHES
    width, total = columns * pitch_x, rows * pitch_y + 0.4
    figure.set_size_inches(width, total)
    figure.suptitle(title, fontsize=12, y=1 - 0.12 / total, va="top")
    for number, panel in enumerate(panels):
        row, column = divmod(number, columns)
        x, y = column * pitch_x + _LEFT_INCHES, (rows - 1 - row) * pitch_y + _BELOW_INCHES
        _draw(panel, field, figure.add_axes((x / width, y / total, _IMAGE_INCHES / width, height / total)))


def _draw(panel: Panel, field: Field, axes: Axes) -> None:
    axes.set_title(panel.title, fontsize=10)
    match panel.kind:
        case "status":
            _draw_status(field, axes)
        case "normals":
            _draw_normals(field, axes)
        case _:
            scale = panel.scale([field])
            _draw_map(panel, field, scale, axes)
            if panel.kind == "arrows":
                _draw_arrows(panel, field, scale, axes)


def _image(axes: Axes, field: Field, values: NDArray[np.floating], **options: Any) -> AxesImage:
    """``values`` on hatched ground, pixel axes; NaN shows the ground."""
    axes.patch.set(facecolor="white", edgecolor="#c9c9c9", hatch="////", linewidth=0)
    axes.tick_params(labelsize=8)
    axes.set_xlabel("x [px]", fontsize=8)
    axes.set_ylabel("y [px]", fontsize=8)
    return axes.imshow(values, extent=(*extent(field.x), *extent(field.y)[::-1]), aspect="equal", **options)


def _draw_map(panel: Panel, field: Field, scale: Scale, axes: Axes) -> None:
    options = {"cmap": scale.colours, "vmin": scale.low, "vmax": scale.high}
    image = _image(axes, field, panel.values(field), **options)
    short = panel.kind == "map" and len(panel.long_name) < 24
    _colour_bar(axes, image, f"{panel.long_name} [{panel.unit}]" if short else f"[{panel.unit}]")


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
    _image(axes, field, normal_image(field["slope_x"], field["slope_y"]))
    legend = axes.inset_axes((1.04, 0.3, 0.3, 0.4))
    legend.imshow(normal_disc(121), extent=(-1, 1, 1, -1), interpolation="bilinear")
    angles = np.linspace(0, 2 * np.pi, 181)
    for tilt in (30, 60):
        radius = math.sin(math.radians(tilt))
        legend.plot(radius * np.cos(angles), radius * np.sin(angles), color="white", linewidth=0.7)
        legend.text(0, 0.97 * radius, f"{tilt}°", color="white", fontsize=6, ha="center", va="bottom")
    legend.set_title("faces", fontsize=8, pad=2)
    legend.set_axis_off()
    for x, y, word, ha, va in ((1.05, 0, "right", "left", "center"), (0, 1.05, "down", "center", "top")):
        legend.text(x, y, word, fontsize=7, ha=ha, va=va)


def _draw_arrows(panel: Panel, field: Field, scale: Scale, axes: Axes) -> None:
    arrows = arrows_of(field, panel.key, scale.high)
    if not arrows.x.size:
        return
    axes.quiver(
        arrows.x,
        arrows.y,
        arrows.u,
        arrows.v,
        angles="xy",
        scale_units="xy",
        scale=1.0,
        color="white",
        edgecolor="black",
        linewidth=0.4,
        width=0.006,
    )


def _draw_status(field: Field, axes: Axes) -> None:
    from matplotlib.patches import Patch

    _image(axes, field, status_colours(field.status), interpolation="nearest")
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
