"""PNG (through imagecodecs) and the portable any-map formats PGM and PPM (P2, P3, P5, P6).

Values are those of the file: PNG of 1, 2 or 4 bit grey is not stretched to 8 bit, gamma and transparency chunks are
not applied; PNM values are not scaled by their maximum.
"""

from __future__ import annotations

import functools
import re
import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from leafflow_ti.capture.channels import Array, Colour, ImageInfo, check_size
from leafflow_ti.errors import InputError, MissingExtra
from leafflow_ti.trace import span

PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
_PNG_COLOURS: dict[int, tuple[Colour, int]] = {
    0: ("gray", 1),
    2: ("rgb", 3),
    3: ("rgb", 3),
    4: ("gray", 2),
    6: ("rgb", 4),
}
_PNM_HEADER = re.compile(rb"P([2356])" + rb"(?:\s|#[^\r\n]*[\r\n])+(\d+)" * 3 + rb"(?:#[^\r\n]*)?\s")
_PNM_HEADER_BYTES = 1 << 16  # room for long comments


def probe_png(path: Path) -> ImageInfo:
    """Header of a PNG file; raises InputError if it is not a complete, valid one."""
    with path.open("rb") as file:
        head = file.read(29)
    if len(head) < 29 or head[12:16] != b"IHDR":
        raise InputError(f"{path}: PNG without a complete header: truncated, copy it again")
    width, height, depth, kind = struct.unpack(">IIBB", head[16:26])
    check_size(path, height, width)
    if kind not in _PNG_COLOURS or depth not in (1, 2, 4, 8, 16):
        raise InputError(f"{path}: PNG of colour type {kind} with {depth} bit is not valid: write it again")
    colour, samples = _PNG_COLOURS[kind]
    bits = 8 if kind == 3 else depth
    dtype = np.dtype(np.uint16 if bits == 16 else np.uint8)
    return ImageInfo(height, width, dtype, bits, samples, colour, windowed=False)


def read_png(path: Path, info: ImageInfo, samples: tuple[int, ...]) -> Array:
    """All rows of the chosen samples, ``[height, width, len(samples)]``; raises InputError or MissingExtra."""
    try:
        import imagecodecs
    except ImportError as error:
        raise MissingExtra("imagecodecs", "codecs", f"reading {path}") from error
    try:
        with span("read"):
            stored = path.read_bytes()
        image: Array = np.asarray(imagecodecs.png_decode(stored))
    except Exception as error:
        raise InputError(f"{path}: damaged PNG ({' '.join(str(error).split())}): copy or write it again") from error
    image = image.reshape(info.height, info.width, -1)[..., list(samples)]
    if info.bits < 8:
        image = image // np.uint8(255 // (2**info.bits - 1))  # the decoder stretches to 8 bit
    return image


@dataclass(frozen=True, slots=True)
class _PnmHeader:
    info: ImageInfo
    plain: bool  # decimal numbers instead of bytes
    maximum: int
    offset: int


@functools.lru_cache(maxsize=1024)
def _pnm_header(path: Path, size: int, _mtime_ns: int) -> _PnmHeader:
    with path.open("rb") as file:
        match = _PNM_HEADER.match(file.read(_PNM_HEADER_BYTES))
    if match is None:
        raise InputError(f"{path}: PNM header is not 'P2, P3, P5 or P6, width, height, maximum': write it again")
    width, height, maximum = (int(match[k]) for k in (2, 3, 4))
    check_size(path, height, width)
    if not 1 <= maximum <= 65535:
        raise InputError(f"{path}: PNM maximum value {maximum} is not within 1 to 65535: write it again")
    plain, samples = match[1] in b"23", 3 if match[1] in b"36" else 1
    dtype = np.dtype(np.uint8 if maximum < 256 else np.uint16)
    end = match.end() + height * width * samples * dtype.itemsize
    if not plain and end != size:
        state = "truncated" if end > size else "several images, or a damaged header"
        raise InputError(f"{path}: PNM data end at byte {end}, the file at {size}: {state}, write one image again")
    colour: Colour = "rgb" if samples == 3 else "gray"
    info = ImageInfo(height, width, dtype, maximum.bit_length(), samples, colour, windowed=not plain)
    return _PnmHeader(info, plain, maximum, match.end())


def _header_of(path: Path) -> _PnmHeader:
    stat = path.stat()
    return _pnm_header(path, stat.st_size, stat.st_mtime_ns)


def probe_pnm(path: Path) -> ImageInfo:
    """Header of a PGM or PPM file; raises InputError if it is invalid or the file's length does not fit."""
    return _header_of(path).info


def read_pnm(path: Path, y0: int, y1: int, x0: int, x1: int, samples: tuple[int, ...]) -> Array:
    """Window ``[y1-y0, x1-x0, len(samples)]``; raises InputError for missing, surplus or too large values."""
    header = _header_of(path)
    shape = (header.info.height, header.info.width, header.info.samples)
    if header.plain:
        with span("read"):
            stored = path.read_bytes()
        words = stored[header.offset :].split()
        if len(words) != np.prod(shape):
            raise InputError(f"{path}: {len(words)} PNM values, {np.prod(shape)} expected: truncated, write it again")
        try:
            values = np.array([int(word) for word in words])
        except ValueError as error:
            raise InputError(f"{path}: PNM values that are no numbers: write it again") from error
        whole: Array = values.reshape(shape)
    else:
        whole = np.memmap(path, header.info.dtype.newbyteorder(">"), "r", header.offset, shape)
    with span("read"):  # mapped: here the bytes are touched
        window = np.asarray(whole[y0:y1, x0:x1, list(samples)])
    if window.min() < 0 or window.max() > header.maximum:
        raise InputError(f"{path}: PNM values above the stated maximum {header.maximum}: damaged, write it again")
    return window.astype(header.info.dtype)
