"""Samples of a TIFF page, window by window; see ``tiff_header`` for what is read and what is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from leafflow_ti.capture.channels import Array
from leafflow_ti.capture.tiff_header import TiffImage, one_line, page_at, quiet, segment_grid
from leafflow_ti.errors import InputError, LeafflowError, MissingExtra
from leafflow_ti.trace import span


def read(path: Path, page: int, y0: int, y1: int, x0: int, x1: int, samples: tuple[int, ...]) -> Array:
    """Samples ``[y1-y0, x1-x0, len(samples)]`` of a non-empty window inside the page, in the page's own type.

    Raises InputError (damaged data) or MissingExtra (a compression that needs imagecodecs).
    """
    source = page_at(path, page)
    height, width = source.stored_shape
    box = (y0, y1, x0, x1) if source.orientation == 1 else (0, height, 0, width)
    stored = (0,) if source.palette is not None else samples
    try:
        if source.contiguous is not None:
            result = _plain_window(path, source, source.contiguous, box, stored)
        else:
            with quiet(), path.open("rb") as file:
                result = _decoded_window(file, source, box, stored)
    except LeafflowError:
        raise
    except Exception as error:
        if (isinstance(error, ImportError) or "imagecodecs" in str(error)) and not _has_imagecodecs():
            raise MissingExtra("imagecodecs", "codecs", f"reading {path}") from error
        raise InputError(f"{path}: page {page} cannot be decoded ({one_line(error)}): write the file again") from error
    if source.inverted:
        result = (2**source.info.bits - 1) - result
    if source.palette is not None:
        result = np.stack([source.palette[k][result[..., 0]] for k in samples], axis=-1)
    if source.orientation != 1:
        result = _orient(result, source.orientation)[y0:y1, x0:x1]
    return result


def _plain_window(
    path: Path, page: TiffImage, dtype: np.dtype[Any], box: tuple[int, int, int, int], samples: tuple[int, ...]
) -> Array:
    """Window of uncompressed data, mapped: only the touched parts of the file are read."""
    (height, width), (y0, y1, x0, x1), n = page.stored_shape, box, page.stored_samples
    shape = (n, height, width) if page.separate else (height, width, n)
    mapped = np.memmap(path, dtype, "r", page.offsets[0], shape)
    whole = np.moveaxis(mapped, 0, -1) if page.separate else mapped
    with span("read"):
        return np.array(whole[y0:y1, x0:x1, list(samples)], dtype.newbyteorder("="))


def _decoded_window(file: BinaryIO, page: TiffImage, box: tuple[int, int, int, int], samples: tuple[int, ...]) -> Array:
    """Window put together from the strips or tiles that it touches."""
    y0, y1, x0, x1 = box
    height, width = page.segment_shape
    rows, columns = segment_grid(page)
    assert page.decode is not None, "plain data are mapped"
    out: Array | None = None
    for plane, into in [(k, [i]) for i, k in enumerate(samples)] if page.separate else [(0, list(range(len(samples))))]:
        for row in range(y0 // height, -(-y1 // height)):
            for column in range(x0 // width, -(-x1 // width)):
                index = plane * rows * columns + row * columns + column
                with span("read"):
                    file.seek(page.offsets[index])
                    stored = file.read(page.counts[index])
                decoded, _, _ = page.decode(stored, index, jpegtables=page.jpegtables)
                if decoded is None:
                    raise ValueError(f"strip or tile {index} is empty")
                tile = decoded[0]
                if out is None:
                    out = np.empty((y1 - y0, x1 - x0, len(samples)), np.uint8 if tile.dtype.kind == "b" else tile.dtype)
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


def _has_imagecodecs() -> bool:
    try:
        import imagecodecs  # noqa: F401
    except ImportError:
        return False
    return True
