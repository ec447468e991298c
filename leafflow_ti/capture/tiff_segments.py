"""Strips and tiles of a compressed TIFF page, decoded one by one in bounded memory.

What a segment may become is known from the header, so no decoder is asked for more: schemes of bytes are given a buffer
of that size, images (JPEG, JPEG 2000, ...) must state that size themselves before they are decoded.
"""

from __future__ import annotations

import functools
import importlib.util
import lzma
import math
import struct
import zlib
from collections.abc import Callable
from typing import Any

import numpy as np
import tifffile

from leafflow_ti.capture.channels import Array

MAX_SEGMENT_BYTES = 2**32
"""Most that one strip or tile may decode to."""

_NONE, _LZW, _PACKBITS, _LZMA = 1, 5, 32773, 34925
_CCITT = (2, 3, 4)
_JPEG = (6, 7, 33007, 34892)
_DEFLATE = (8, 32946, 50013)
_ZSTD = (34926, 50000)
_JPEG_2000 = (33003, 33004, 33005, 34712)
_OWN_SIZE = {34933: "png", 34927: "webp", 50001: "webp", 50002: "jpegxl", 52546: "jpegxl", 34887: "lerc"}
"""Images whose decoders in imagecodecs compare the size that they state with that of a given array first."""

_GREATEST_RATIO = {
    _NONE: 1,
    _LZW: 1400,  # codes of 9 to 12 bits, each for one byte more than the last, until the table is full
    _PACKBITS: 64,  # 128 bytes of 2
    _LZMA: 2**13,  # 273 bytes a match of about 0.3 bits
    **dict.fromkeys(_DEFLATE, 1032),  # 258 bytes a match of 2 bits
    **dict.fromkeys(_ZSTD, 2**15),  # 128 KiB a block of 4 bytes
    **dict.fromkeys(_JPEG, 2**13),  # 64 samples a block; progressive scans say "nothing" of 2**15 blocks at a time
}
"""Bytes that one stored byte can stand for; schemes that are left out know no such limit."""

PREDICTED = frozenset({_LZW, _LZMA, *_DEFLATE, *_ZSTD})
"""Compressions before which a predictor is applied."""
PICTURES = frozenset({*_JPEG, *_JPEG_2000, *_OWN_SIZE})
"""Compressions that are formats of images themselves; predictors are ignored."""
READ = frozenset({*_GREATEST_RATIO, *_CCITT, *PICTURES})
"""Compressions that are read, by their number."""

Decode = Callable[[bytes, int], Array]
"""From the stored bytes and the number of a segment to its samples ``[rows, columns, samples]``."""
Shapes = Callable[[int], tuple[tuple[int, int], ...]]
"""Rows and columns that a segment may have, by its number; the usual ones first."""


def greatest_ratio(compression: int) -> float:
    """Bytes that one stored byte can stand for."""
    return _GREATEST_RATIO.get(compression, math.inf)


def stored_limit(compression: int, whole: int, row: int) -> int:
    """Most bytes that a segment may take which decodes to ``whole`` in rows of ``row`` bytes: no scheme lets noise grow
    more; what is not compressed may be padded, by less than a row."""
    return whole + row - 1 if compression == _NONE else 16 * whole + 2**20


def decoder(page: tifffile.TiffPage, shapes: Shapes, samples: int) -> Decode:
    """Decoder of a page that may be called after its file was closed.

    ``samples``: of a pixel in one segment. The decoder raises ValueError
    or what a codec raises for damaged data, ImportError where imagecodecs is needed and absent.
    """
    compression, dtype, bits = int(page.compression), page.dtype, int(page.bitspersample)
    assert dtype is not None, "pages of unknown type are refused"
    if compression in _OWN_SIZE and has_imagecodecs():
        return functools.partial(_decode_own_size, _OWN_SIZE[compression], shapes, samples, dtype)
    decode, tables = page.decode, page.jpegtables
    stated = np.dtype(np.uint8) if dtype.kind == "b" else dtype.newbyteorder("=")

    def decoded(stored: bytes, index: int) -> Array:
        if compression in (*_JPEG, *_JPEG_2000):
            _check_stated(stored, compression, shapes(index), samples)
        elif not has_imagecodecs():
            _check_without_imagecodecs(stored, compression, page)
        result, _, _ = decode(stored, index, jpegtables=tables)
        if result is None:
            raise ValueError(f"strip or tile {index} is empty")
        segment: Array = result[0].view(np.uint8) if dtype.kind == "b" else result[0]
        states_depth = compression in (*_JPEG, *_JPEG_2000, *_CCITT)
        if segment.dtype != stated or (states_depth and segment.max() >= 2**bits):
            raise ValueError(f"a strip or tile of {segment.dtype} up to {segment.max()}, the header states {bits} bit")
        return segment

    return decoded


def _decode_own_size(
    codec: str, shapes: Shapes, samples: int, dtype: np.dtype[Any],
    stored: bytes, index: int,
) -> Array:  # fmt: skip
    """An image into an array of the size that is expected; the codec refuses one that states another."""
    import imagecodecs

    shape = shapes(index)[0]
    out = np.empty(shape if samples == 1 else (*shape, samples), dtype)
    options = {"hasalpha": True} if codec == "webp" and samples == 4 else {}
    getattr(imagecodecs, f"{codec}_decode")(stored, out=out, **options)
    return out.reshape(*shape, samples)


def _check_stated(stored: bytes, compression: int, shapes: tuple[tuple[int, int], ...], samples: int) -> None:
    """Size, samples and end of an image, as it states them; raises ValueError."""
    if compression in _JPEG:
        rows, columns, found = _jpeg_size(stored)
        # A picture that is cut off decodes as well, the rest of it grey.
        if not stored.rstrip(b"\0\xff").endswith(b"\xff\xd9"):
            raise ValueError("JPEG data end before the picture does")
    else:
        rows, columns, found = _jpeg_2000_size(stored)
    if (rows, columns) not in shapes or found != samples:
        wanted = " or ".join(f"{shape[0]} x {shape[1]}" for shape in dict.fromkeys(shapes))
        raise ValueError(f"a strip or tile of {rows} x {columns} with {found} samples, not {wanted} with {samples}")


def _jpeg_size(stored: bytes) -> tuple[int, int, int]:
    """Rows, columns and samples in the frame header of a JPEG stream (ITU-T T.81, B.2.2); raises ValueError."""
    at = 2 if stored[:2] == b"\xff\xd8" else len(stored)
    while at + 4 <= len(stored) and stored[at] == 0xFF:
        marker = stored[at + 1]
        if marker == 0xFF:  # fill bytes
            at += 1
        elif 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC) and at + 10 <= len(stored):
            rows, columns, samples = struct.unpack_from(">HHB", stored, at + 5)
            return rows, columns, samples
        elif marker == 0x01 or 0xD0 <= marker <= 0xD7:  # markers that stand alone
            at += 2
        else:
            at += 2 + int.from_bytes(stored[at + 2 : at + 4], "big")
    raise ValueError("JPEG data without a frame header")


def _jpeg_2000_size(stored: bytes) -> tuple[int, int, int]:
    """Rows, columns and samples in the SIZ marker of a JPEG 2000 codestream (ITU-T T.800, A.5.1)."""
    at = stored.find(b"\xff\x4f\xff\x51")
    if at < 0 or at + 42 > len(stored):
        raise ValueError("JPEG 2000 data without a size")
    right, bottom, left, top = struct.unpack_from(">4I", stored, at + 8)
    (samples,) = struct.unpack_from(">H", stored, at + 40)
    return bottom - top, right - left, samples


def _check_without_imagecodecs(stored: bytes, compression: int, page: tifffile.TiffPage) -> None:
    """What tifffile itself decodes is not bounded by it: measured here first. Raises ValueError or ImportError."""
    needs = int(page.bitspersample) not in (8, 16, 32, 64) or page.fillorder != 1 or page.predictor not in (1, 2)
    if compression not in (_NONE, _PACKBITS, _LZMA, *_DEFLATE) or needs:
        raise ImportError("imagecodecs")
    limit = segment_bytes(page) + 1
    if compression in _DEFLATE:
        grown = len(zlib.decompressobj().decompress(stored, limit))
    elif compression == _LZMA:
        grown = len(lzma.LZMADecompressor().decompress(stored, limit))
    else:
        return
    if grown >= limit:
        raise ValueError(f"a strip or tile decodes to more than {limit - 1} bytes")


def segment_bytes(page: tifffile.TiffPage) -> int:
    """Bytes of a whole strip or tile of a page, decoded but still packed."""
    samples = page.samplesperpixel if page.planarconfig == 1 else 1
    rows, columns = (page.tilelength, page.tilewidth) if page.is_tiled else (page.rowsperstrip, page.imagewidth)
    return rows * packed_row(columns * samples, int(page.bitspersample))


def packed_row(samples: int, bits: int) -> int:
    """Bytes of a row of packed samples."""
    return -(-samples * bits // 8)


@functools.cache
def has_imagecodecs() -> bool:
    """Whether the package of codecs is installed."""
    return importlib.util.find_spec("imagecodecs") is not None
