"""PNG (through imagecodecs) and the portable any-map formats PGM and PPM (P2, P3, P5, P6).

Values are those of the file: PNG of 1, 2 or 4 bit grey is not stretched to 8 bit, gamma and transparency chunks are
not applied; PNM values are not scaled by their maximum.
"""

from __future__ import annotations

import functools
import math
import re
import struct
from dataclasses import dataclass

import numpy as np

from leafflow_ti.capture.channels import Array, Colour, ImageInfo, check_size
from leafflow_ti.capture.stored import StoredFile, one_line
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
_PNG_DEPTHS = {0: (1, 2, 4, 8, 16), 2: (8, 16), 3: (1, 2, 4, 8), 4: (8, 16), 6: (8, 16)}
_PNG_RATIO = 1032  # of Deflate: 258 bytes of 2 bits
_PNG_PARTS = (b"IHDR", b"PLTE", b"IDAT", b"IEND")
_PNG_SPARE = 2**16  # bytes that small images may take beyond twice their size
_PNM_HEADER = re.compile(rb"P([2356])" + rb"(?:\s|#[^\r\n]*[\r\n])+(\d{1,10})" * 3 + rb"(?:#[^\r\n]*)?\s")
_PNM_HEADER_BYTES = 1 << 16  # room for long comments
_PNM_DIGITS = b"0123456789 \t\n\v\f\r"
_PNM_WIDEST = 16  # bytes of one decimal value and the blanks after it, on average


@functools.lru_cache(maxsize=1024)
def probe_png(stored: StoredFile) -> ImageInfo:
    """Header of a PNG file; raises InputError if it is not a complete, valid one."""
    path = stored.path
    with stored.open() as file:
        head = file.read(0, min(29, stored.size))
    if len(head) < 29 or head[12:16] != b"IHDR":
        raise InputError(f"{path}: PNG without a complete header: truncated, copy it again")
    width, height, depth, kind = struct.unpack(">IIBB", head[16:26])
    check_size(path, height, width)
    if depth not in _PNG_DEPTHS.get(kind, ()):
        raise InputError(f"{path}: PNG of colour type {kind} with {depth} bit is not valid: write it again")
    colour, samples = _PNG_COLOURS[kind]
    n_bytes = height * (width * depth * (1 if kind == 3 else samples) / 8)
    if n_bytes > _PNG_RATIO * stored.size:
        raise InputError(
            f"{path}: header states {height} x {width} pixels, too many for a PNG of {stored.size} bytes: "
            "damaged or truncated, copy it again"
        )
    bits = 8 if kind == 3 else depth
    dtype = np.dtype(np.uint16 if bits == 16 else np.uint8)
    return ImageInfo(height, width, dtype, bits, samples, colour, windowed=False)


def read_png(stored: StoredFile, info: ImageInfo, samples: tuple[int, ...]) -> Array:
    """All rows of the chosen samples, ``[height, width, len(samples)]``; raises InputError or MissingExtra."""
    path = stored.path
    try:
        import imagecodecs
    except ImportError as error:
        raise MissingExtra("imagecodecs", "codecs", f"reading {path}") from error
    with span("read"):
        content = _png_image(stored, info)
    try:
        image: Array = np.asarray(imagecodecs.png_decode(content)).reshape(info.height, info.width, -1)
    except MemoryError:
        raise
    except Exception as error:
        raise InputError(f"{path}: damaged PNG ({one_line(error)}): copy or write it again") from error
    image = image[..., list(samples)]
    if info.bits < 8:
        image = image // np.uint8(255 // (2**info.bits - 1))  # the decoder stretches to 8 bit
    return image


def _png_image(stored: StoredFile, info: ImageInfo) -> bytes:
    """The file without all that is no pixel: texts and profiles may be bombs, and none of them is used."""
    path = stored.path
    parts, at, pixels, kind = [PNG_MAGIC], len(PNG_MAGIC), 0, b""
    with stored.open() as file:
        while kind != b"IEND":
            length, kind = struct.unpack(">I4s", file.read(at, 8))
            if kind in _PNG_PARTS:
                parts.append(file.read(at, length + 12))
                pixels += length if kind == b"IDAT" else 0
            elif kind[0] & 0x20 == 0:
                raise InputError(f"{path}: damaged PNG (chunk {kind!r} is unknown): copy or write it again")
            at += length + 12
    if pixels > 2 * info.height * info.width * info.samples * info.dtype.itemsize + _PNG_SPARE:
        raise InputError(f"{path}: {pixels} bytes for {info.height} x {info.width} pixels: damaged, write it again")
    return b"".join(parts)


@dataclass(frozen=True, slots=True)
class _PnmHeader:
    info: ImageInfo
    plain: bool  # decimal numbers instead of bytes
    maximum: int
    offset: int


@functools.lru_cache(maxsize=1024)
def _pnm_header(stored: StoredFile) -> _PnmHeader:
    path, size = stored.path, stored.size
    with stored.open() as file:
        match = _PNM_HEADER.match(file.read(0, min(_PNM_HEADER_BYTES, size)))
    if match is None:
        raise InputError(f"{path}: PNM header is not 'P2, P3, P5 or P6, width, height, maximum': write it again")
    width, height, maximum = (int(match[k]) for k in (2, 3, 4))
    check_size(path, height, width)
    if not 1 <= maximum <= 65535:
        raise InputError(f"{path}: PNM maximum value {maximum} is not within 1 to 65535: write it again")
    plain, samples = match[1] in b"23", 3 if match[1] in b"36" else 1
    dtype = np.dtype(np.uint8 if maximum < 256 else np.uint16)
    _check_pnm_length(stored, match.end(), height * width * samples, None if plain else dtype.itemsize)
    colour: Colour = "rgb" if samples == 3 else "gray"
    info = ImageInfo(height, width, dtype, maximum.bit_length(), samples, colour, windowed=not plain)
    return _PnmHeader(info, plain, maximum, match.end())


def _check_pnm_length(stored: StoredFile, offset: int, count: int, itemsize: int | None) -> None:
    """Whether ``count`` values after the header fit the file; ``itemsize`` None: decimal numbers."""
    path, size = stored.path, stored.size
    if itemsize is None:
        if not 2 * count - 1 <= size - offset <= _PNM_WIDEST * count + _PNM_HEADER_BYTES:
            raise InputError(f"{path}: {size - offset} bytes for {count} PNM values cannot be: write it again")
        return
    end = offset + count * itemsize
    if end != size:
        state = "truncated" if end > size else "several images, or a damaged header"
        raise InputError(f"{path}: PNM data end at byte {end}, the file at {size}: {state}, write one image again")


def probe_pnm(stored: StoredFile) -> ImageInfo:
    """Header of a PGM or PPM file; raises InputError if it is invalid or the file's length does not fit."""
    return _pnm_header(stored).info


def read_pnm(stored: StoredFile, box: tuple[int, int, int, int], samples: tuple[int, ...]) -> Array:
    """Window ``[y1-y0, x1-x0, len(samples)]`` of ``box`` (y0, y1, x0, x1); raises InputError for missing, surplus or
    too large values."""
    header = _pnm_header(stored)
    y0, y1, x0, x1 = box
    if header.plain:
        window = _decimals(stored, header)[y0:y1, x0:x1, list(samples)]
    else:
        width, pixel = header.info.width, header.info.samples * header.info.dtype.itemsize
        offset = header.offset + y0 * width * pixel
        with span("read"), stored.open(buffering=0) as file:
            rows = file.read_rows(offset, width * pixel, y1 - y0, x0 * pixel, x1 * pixel)
        window = rows.view(header.info.dtype.newbyteorder(">")).reshape(y1 - y0, x1 - x0, -1)[..., list(samples)]
    if window.max() > header.maximum:
        raise InputError(
            f"{stored.path}: PNM values above the stated maximum {header.maximum}: damaged, write it again"
        )
    return window.astype(header.info.dtype)


def _decimals(stored: StoredFile, header: _PnmHeader) -> Array:
    """All values of a file of decimal numbers, ``[height, width, samples]``, as float: none is too long for it."""
    with span("read"):
        content = stored.read_all()[header.offset :]
    if content.translate(None, _PNM_DIGITS):
        raise InputError(f"{stored.path}: PNM values that are no numbers: write it again")
    shape = (header.info.height, header.info.width, header.info.samples)
    values: Array = np.fromstring(content, np.float64, sep=" ")
    if len(values) != math.prod(shape):
        raise InputError(
            f"{stored.path}: {len(values)} PNM values, {math.prod(shape)} expected: truncated, write it again"
        )
    return values.reshape(shape)
