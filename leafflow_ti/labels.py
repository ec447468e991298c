"""Label images: one whole number per pixel, 0 for what is no region, one number for each leaf.

They are what PlantCV writes as a mask (0 and 255, one region) or a labelled mask, what napari saves of a labels layer,
and what Fiji saves after a segmentation: TIFF or PNG with whole numbers of 8, 16 or 32 bits, of the size of the images.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from leafflow_ti.capture.images import page_info, probe, read_window
from leafflow_ti.errors import InputError, UsageError
from leafflow_ti.results import ResultStore

LabelImage = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class Labels:
    """Label images of a store. ``source``: a file, or an array [H, W] or [T, H, W]; ``index``: position along t of the
    frame that a single image shows, None for a stack with one page per frame; ``values``: the labels of the image, or
    of the stack's first page."""

    source: Path | NDArray[Any]
    index: int | None
    values: tuple[int, ...]

    @classmethod
    def of(cls, labels: str | Path | ArrayLike, store: ResultStore, frame: int | None = None) -> Labels:
        """Label images that belong to a store.

        ``frame``: index of the frame that a single image shows, None: the middle one of the store, which quick looks
        show, too.
        Raises InputError for files and arrays that do not fit the store, UsageError for a frame that makes no sense.
        """
        source = Path(labels) if isinstance(labels, str | Path) else np.asarray(labels)
        pages = probe(source).pages if isinstance(source, Path) else (source.shape[0] if source.ndim == 3 else 1)
        if pages not in (1, len(store.frames)):
            raise InputError(
                f"{_name(source)}: {pages} pages for the {len(store.frames)} frames of {store.path}: give one label "
                "image, or one page for each of these frames"
            )
        single = pages == 1 and (frame is not None or len(store.frames) > 1 or not _is_stack(source))
        if not single and frame is not None:
            raise UsageError(f"labels frame {frame}: {_name(source)} has a page for every frame, so leave it out")
        frame = store.frames[len(store.frames) // 2] if frame is None else frame
        if single and frame not in store.frames:
            held = f"{store.frames[0]}..{store.frames[-1]}"
            raise UsageError(f"labels frame {frame}: {store.path} holds the frames {held}: choose one of them")
        found = cls(source, store.frames.index(frame) if single else None, ())
        image = found.image(0)
        _check_size(source, image, store)
        values = tuple(int(v) for v in np.unique(image) if v > 0)
        if not values:
            raise InputError(f"{_name(source)}: no labels, all pixels are 0: give each leaf a whole number from 1 on")
        return cls(source, found.index, values)

    def image(self, page: int) -> LabelImage:
        """One page [H, W].

        Raises InputError for colour pictures, and for values that are no labels.
        """
        if isinstance(self.source, Path):
            values = _read(self.source, page)
        else:
            values = self.source[page] if self.source.ndim == 3 else self.source
            if values.ndim != 2:
                raise InputError(f"labels of shape {self.source.shape}: give [height, width] or [frame, height, width]")
        return _whole_numbers(self.source, values)


@dataclass(frozen=True, eq=False)
class Coverage:
    """Where a region is in the maps of a store: ``share`` [0..1] of the pixels that each entry of the maps' part
    ``cut`` (rows, columns) stands for, that are the region's; ``block``: how many these are."""

    cut: tuple[slice, slice]
    share: NDArray[np.float64]
    block: int

    @classmethod
    def everywhere(cls, shape: tuple[int, int]) -> Coverage:
        """All of maps of this shape."""
        return cls((slice(0, shape[0]), slice(0, shape[1])), np.ones(shape), 1)

    @property
    def pixels(self) -> int:
        """Pixels of the image that are the region's."""
        return round(float(self.share.sum()) * self.block)


def covered(store: ResultStore, image: LabelImage, value: int) -> Coverage | None:
    """Where the pixels with the label ``value`` are; None where no map reaches them."""
    rows, columns = np.nonzero(image == value)
    if not rows.size:
        return None
    span = (float(rows.min()), float(rows.max()), float(columns.min()), float(columns.max()))
    return cover(store, span, lambda points: looked_up(image, points) == value)


def cover(
    store: ResultStore, span: tuple[float, float, float, float], inside: Callable[[NDArray[np.float64]], NDArray[Any]]
) -> Coverage | None:
    """The coverage of a region within the rows and columns ``span`` (first and last of each) px; None where no map
    reaches it.

    ``inside``: tells of points (x, y) [2, n] px whether [n] they are the region's.
    """
    axes = []
    for positions, low, high in ((store.y, *span[:2]), (store.x, *span[2:])):
        pitch = int(positions[1] - positions[0]) if positions.size > 1 else 1
        half = pitch // 2
        first = int(np.searchsorted(positions, low - half))
        last = int(np.searchsorted(positions, high + half, side="right"))
        axes.append((slice(first, last), np.add.outer(positions[first:last], np.arange(-half, half + 1)), pitch))
    (rows, y, pitch_y), (columns, x, pitch_x) = axes
    if not y.size or not x.size:
        return None
    fine = np.meshgrid(y.ravel(), x.ravel(), indexing="ij")
    hits = inside(np.stack([fine[1].ravel(), fine[0].ravel()]).astype(np.float64))
    share = np.einsum("yixj,i,j->yx", hits.reshape(*y.shape, *x.shape), _even(pitch_y), _even(pitch_x))
    return Coverage((rows, columns), share, pitch_y * pitch_x)


def _even(pitch: int) -> NDArray[np.float64]:
    """Weights of the pixels around an entry of the maps; with an even pitch the outermost lie between two entries."""
    weights = np.full(2 * (pitch // 2) + 1, 1 / pitch)
    if pitch % 2 == 0:
        weights[[0, -1]] /= 2
    return weights


def looked_up(image: LabelImage, points: NDArray[np.float64]) -> LabelImage:
    """Labels [n] at points (x, y) [2, n] px, that of the nearest pixel; 0 beyond the image."""
    x, y = np.floor(points + 0.5).astype(np.int64)  # np.rint would take two of four halves
    height, width = image.shape
    known = (x >= 0) & (x < width) & (y >= 0) & (y < height)
    found = np.zeros(x.size, np.int64)
    found[known] = image[y[known], x[known]]
    return found


def _is_stack(source: Path | NDArray[Any]) -> bool:
    return not isinstance(source, Path) and source.ndim == 3


def _name(source: Path | NDArray[Any]) -> str:
    return str(source) if isinstance(source, Path) else "labels"


def _read(path: Path, page: int) -> NDArray[Any]:
    info = page_info(path, page)
    if info.colour != "gray":
        raise InputError(
            f"{path}: a colour picture, labels are one whole number per pixel: save the labels themselves, not their "
            "colours (PlantCV: the labelled mask; napari: the labels layer; Fiji: before a colour table is applied)"
        )
    return read_window(path, page, "luminance", 0, info.height, 0, info.width)


def _whole_numbers(source: Path | NDArray[Any], values: NDArray[Any]) -> LabelImage:
    with np.errstate(invalid="ignore"):
        labels: LabelImage = values.astype(np.int64)
    if (values.dtype.kind == "f" and not np.array_equal(labels, values)) or labels.min() < 0:
        raise InputError(f"{_name(source)}: values that are no labels: they must be whole numbers, 0 or more")
    return labels


def _check_size(source: Path | NDArray[Any], image: LabelImage, store: ResultStore) -> None:
    height, width = image.shape
    wanted = store.attrs.get("plan", {}).get("image_px")
    if wanted is not None and [width, height] != list(wanted):
        raise InputError(
            f"{_name(source)}: labels of {width} x {height} pixels for images of {wanted[0]} x {wanted[1]}: make them "
            "the same size (the whole image, also where a part of it was measured)"
        )
    if store.x[-1] >= width or store.y[-1] >= height:  # results that do not say the size of their images
        raise InputError(
            f"{_name(source)}: labels of {width} x {height} pixels, but results reach to x = {store.x[-1]}, "
            f"y = {store.y[-1]}: make them as large as the images"
        )
