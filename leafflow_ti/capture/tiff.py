"""Samples of a TIFF page, window by window; see ``tiff_header`` for what is read and what is refused."""

from __future__ import annotations

from typing import Any

import numpy as np

from leafflow_ti.capture.channels import Array
from leafflow_ti.capture.stored import OpenFile, StoredFile, one_line
from leafflow_ti.capture.tiff_header import TiffImage, page_at, quiet, segment_grid
from leafflow_ti.capture.tiff_segments import has_imagecodecs
from leafflow_ti.errors import InputError, LeafflowError, MissingExtra
from leafflow_ti.trace import span

Box = tuple[int, int, int, int]
"""First row, row after the last, first column, column after the last."""


def read(stored: StoredFile, page: int, box: Box, samples: tuple[int, ...]) -> Array:
    """Samples ``[rows, columns, len(samples)]`` of a non-empty window inside the page, in the page's own type.

    Raises InputError (damaged data, a file that changed) or MissingExtra (a compression that needs imagecodecs).
    """
    source = page_at(stored, page)
    height, width = source.stored_shape
    whole = source.orientation != 1
    try:
        with quiet(), stored.open(buffering=0) as file:
            load = _plain_window if source.contiguous is not None else _decoded_window
            result = load(
                file, source, (0, height, 0, width) if whole else box, (0,) if source.palette is not None else samples
            )
    except (LeafflowError, MemoryError):
        raise
    except Exception as error:
        path = stored.path
        if (isinstance(error, ImportError) or "imagecodecs" in str(error)) and not has_imagecodecs():
            raise MissingExtra("imagecodecs", "codecs", f"reading {path}") from error
        raise InputError(f"{path}: page {page} cannot be decoded ({one_line(error)}): write the file again") from error
    if source.inverted:
        result = (2**source.info.bits - 1) - result
    if source.palette is not None:
        result = np.stack([source.palette[k][result[..., 0]] for k in samples], axis=-1)
    if whole:
        result = _orient(result, source.orientation)[box[0] : box[1], box[2] : box[3]]
    return result


def _plain_window(file: OpenFile, page: TiffImage, box: Box, samples: tuple[int, ...]) -> Array:
    """Window of uncompressed data: only the bytes of its rows are read."""
    dtype, (height, width) = page.contiguous, page.stored_shape
    assert dtype is not None
    if not page.separate:
        stored = _rows(file, page.offsets[0], dtype, page.stored_samples, width, box)
        return stored if samples == tuple(range(page.stored_samples)) else stored[..., list(samples)]
    plane = height * width * dtype.itemsize
    return np.concatenate([_rows(file, page.offsets[0] + k * plane, dtype, 1, width, box) for k in samples], axis=-1)


def _rows(file: OpenFile, offset: int, dtype: np.dtype[Any], samples: int, width: int, box: Box) -> Array:
    """Window ``[rows, columns, samples]`` of interleaved samples, in the machine's byte order."""
    y0, y1, x0, x1 = box
    pixel = samples * dtype.itemsize
    with span("read"):
        stored = file.read_rows(offset + y0 * width * pixel, width * pixel, y1 - y0, x0 * pixel, x1 * pixel)
    values: Array = stored.view(dtype).reshape(y1 - y0, x1 - x0, samples)
    return values.astype(dtype.newbyteorder("="), copy=False)


def _decoded_window(file: OpenFile, page: TiffImage, box: Box, samples: tuple[int, ...]) -> Array:
    """Window put together from the strips or tiles that it touches."""
    y0, y1, x0, x1 = box
    height, width = page.segment_shape
    rows, columns = segment_grid(page)
    assert page.decode is not None, "plain data are not decoded"
    out: Array | None = None
    for plane, into in [(k, [i]) for i, k in enumerate(samples)] if page.separate else [(0, list(range(len(samples))))]:
        for row in range(y0 // height, -(-y1 // height)):
            for column in range(x0 // width, -(-x1 // width)):
                index = plane * rows * columns + row * columns + column
                with span("read"):
                    stored = file.read(page.offsets[index], page.counts[index])
                tile = page.decode(stored, index)
                if out is None:
                    out = np.empty((y1 - y0, x1 - x0, len(samples)), tile.dtype)
                top, left = row * height, column * width
                ya, yb = max(y0, top), min(y1, top + height)
                xa, xb = max(x0, left), min(x1, left + width)
                part = tile[ya - top : yb - top, xa - left : xb - left]
                if part.shape[:2] != (yb - ya, xb - xa):
                    raise ValueError(f"strip or tile {index} is too short")
                chosen = part if page.separate else part[..., list(samples)]
                out[ya - y0 : yb - y0, xa - x0 : xb - x0, into] = chosen
    assert out is not None, "the window is not empty"
    return out


def _orient(image: Array, orientation: int) -> Array:
    """Stored rows and columns to those of the upright picture (TIFF 6.0, tag 274)."""
    if orientation > 4:
        image = image.swapaxes(0, 1)
    if orientation in (3, 4, 7, 8):
        image = image[::-1]
    if orientation in (2, 3, 6, 7):
        image = image[:, ::-1]
    return image
