"""Image files: header, whole grey page, or a window of one; TIFF, PNG, PGM and PPM, told apart by content.

Axes are ``[y, x]``, y down. Values keep the file's own scale (an integer file gives those integers). As float32 they
are exact for integers up to 24 bit and for float16 and float32; ask for float64 where 32-bit integers or float64 data
must stay exact.
"""

from __future__ import annotations

import hashlib
from functools import lru_cache
from pathlib import Path

import numpy as np
import numpy.typing as npt

from leafflow_ti.capture import simple_formats, tiff, tiff_header
from leafflow_ti.capture.channels import Array, Channel, ImageInfo, combine, sample_weights
from leafflow_ti.capture.stored import StoredFile, look_at
from leafflow_ti.errors import InputError

_TIFF_MAGIC = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")


def probe(path: str | Path) -> ImageInfo:
    """Size, type, depth, colour and pages of an image file, from its headers alone.

    Raises InputError, naming the file, if it is missing, of another format, damaged, or of a kind that is not read.
    """
    stored = look_at(Path(path))
    kind = _format(stored)
    if kind == "tiff":
        return tiff_header.probe(stored)
    return simple_formats.probe_png(stored) if kind == "png" else simple_formats.probe_pnm(stored)


def read_gray(
    path: str | Path, page: int = 0, channel: Channel = "luminance", dtype: npt.DTypeLike = np.float32
) -> Array:
    """Grey values ``[height, width]`` of one page (from 0), as ``dtype``, in the file's own scale.

    Colour becomes grey by ``channel`` (see ``channels.sample_weights``); alpha that the file declares is ignored.
    Raises InputError for a damaged or unsuitable file and MissingExtra where imagecodecs is needed and absent.
    """
    stored = look_at(Path(path))
    info = _page_info(stored, page)
    values = _window(stored, page, info, channel, (0, info.height, 0, info.width))
    # What is too large for the type becomes infinite; the program knows what to do with that.
    with np.errstate(over="ignore"):
        return values.astype(dtype, copy=False)


def page_info(path: Path, page: int) -> ImageInfo:
    """Header of one page; the pages of a TIFF may differ."""
    return _page_info(look_at(path), page)


def read_window(path: Path, page: int, channel: Channel, y0: int, y1: int, x0: int, x1: int) -> Array:
    """Grey window ``[y1-y0, x1-x0]`` inside the page, as stored (a mixture of colours as float).

    Only the needed bytes, strips or tiles are read where ``ImageInfo.windowed`` says so. Raises like ``read_gray``.
    """
    stored = look_at(path)
    info = _page_info(stored, page)
    if not (0 <= y0 < y1 <= info.height and 0 <= x0 < x1 <= info.width):
        raise InputError(f"{path}: window y {y0}:{y1}, x {x0}:{x1} is not inside {info.height} x {info.width} pixels")
    return _window(stored, page, info, channel, (y0, y1, x0, x1))


def _page_info(stored: StoredFile, page: int) -> ImageInfo:
    kind = _format(stored)
    if kind == "tiff":
        return tiff_header.page_at(stored, page).info
    if page != 0:
        raise InputError(f"{stored.path}: no page {page}, the file holds one image")
    return simple_formats.probe_png(stored) if kind == "png" else simple_formats.probe_pnm(stored)


def _window(stored: StoredFile, page: int, info: ImageInfo, channel: Channel, box: tuple[int, int, int, int]) -> Array:
    weights = sample_weights(stored.path, info, channel)
    samples = tuple(index for index, _ in weights)
    kind = _format(stored)
    try:
        if kind == "tiff":
            values = tiff.read(stored, page, box, samples)
        elif kind == "png":
            values = simple_formats.read_png(stored, info, samples)[box[0] : box[1], box[2] : box[3]]
        else:
            values = simple_formats.read_pnm(stored, box, samples)
        return combine(values, weights)
    except MemoryError as error:
        raise InputError(
            f"{stored.path}: {info.height} x {info.width} pixels need more memory than there is: crop the image, or "
            "save it in strips or tiles"
        ) from error


@lru_cache(maxsize=4096)
def _format(stored: StoredFile) -> str:
    """Format by the first bytes."""
    with stored.open() as file:
        head = file.read(0, min(8, stored.size))
    if head[:4] in _TIFF_MAGIC:
        return "tiff"
    if head == simple_formats.PNG_MAGIC:
        return "png"
    if head[:2] in (b"P2", b"P3", b"P5", b"P6"):
        return "pnm"
    found = "an empty file" if not head else "another format"
    raise InputError(f"{stored.path}: {found}, not TIFF, PNG, PGM or PPM: convert it, or narrow the pattern")


def checksum(path: Path) -> str:
    """sha256 of a file's bytes."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
