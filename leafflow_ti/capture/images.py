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
from leafflow_ti.errors import InputError

_TIFF_MAGIC = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")


def probe(path: str | Path) -> ImageInfo:
    """Size, type, depth, colour and pages of an image file, from its headers alone.

    Raises InputError, naming the file, if it is missing, of another format, damaged, or of a kind that is not read.
    """
    path = Path(path)
    kind = _format(path)
    if kind == "tiff":
        return tiff_header.probe(path)
    return simple_formats.probe_png(path) if kind == "png" else simple_formats.probe_pnm(path)


def read_gray(
    path: str | Path, page: int = 0, channel: Channel = "luminance", dtype: npt.DTypeLike = np.float32
) -> Array:
    """Grey values ``[height, width]`` of one page (from 0), as ``dtype``, in the file's own scale.

    Colour becomes grey by ``channel`` (see ``channels.sample_weights``); alpha that the file declares is ignored.
    Raises InputError for a damaged or unsuitable file and MissingExtra where imagecodecs is needed and absent.
    """
    path = Path(path)
    info = page_info(path, page)
    return read_window(path, page, channel, 0, info.height, 0, info.width).astype(dtype, copy=False)


def page_info(path: Path, page: int) -> ImageInfo:
    """Header of one page; the pages of a TIFF may differ."""
    if _format(path) == "tiff":
        return tiff_header.page_at(path, page).info
    if page != 0:
        raise InputError(f"{path}: no page {page}, the file holds one image")
    return probe(path)


def read_window(path: Path, page: int, channel: Channel, y0: int, y1: int, x0: int, x1: int) -> Array:
    """Grey window ``[y1-y0, x1-x0]`` inside the page, as stored (a mixture of colours as float).

    Only the needed bytes, strips or tiles are read where ``ImageInfo.windowed`` says so. Raises like ``read_gray``.
    """
    info = page_info(path, page)
    if not (0 <= y0 < y1 <= info.height and 0 <= x0 < x1 <= info.width):
        raise InputError(f"{path}: window y {y0}:{y1}, x {x0}:{x1} is not inside {info.height} x {info.width} pixels")
    weights = sample_weights(path, info, channel)
    samples = tuple(index for index, _ in weights)
    kind = _format(path)
    if kind == "tiff":
        values = tiff.read(path, page, y0, y1, x0, x1, samples)
    elif kind == "png":
        values = simple_formats.read_png(path, info, samples)[y0:y1, x0:x1]
    else:
        values = simple_formats.read_pnm(path, y0, y1, x0, x1, samples)
    return combine(values, weights)


def _format(path: Path) -> str:
    try:
        stat = path.stat()
        return _format_of(path, stat.st_size, stat.st_mtime_ns)
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}): check the path and its permissions") from error


@lru_cache(maxsize=4096)
def _format_of(path: Path, _size: int, _mtime_ns: int) -> str:
    """Format by the first bytes, remembered until size or time of the file change."""
    with path.open("rb") as file:
        head = file.read(8)
    if head[:4] in _TIFF_MAGIC:
        return "tiff"
    if head == simple_formats.PNG_MAGIC:
        return "png"
    if head[:2] in (b"P2", b"P3", b"P5", b"P6"):
        return "pnm"
    found = "an empty file" if not head else "another format"
    raise InputError(f"{path}: {found}, not TIFF, PNG, PGM or PPM: convert it, or narrow the pattern")


def checksum(path: Path) -> str:
    """sha256 of a file's bytes."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
