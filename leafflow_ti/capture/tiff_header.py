"""Headers of TIFF files through tifffile: which pages there are, and all that reading one needs.

Pages are counted in the order of the file; reduced-resolution images and transparency masks are no pages. OME and
other files that spread a series over several files are read as what each file itself holds. Decided here:

* MINISWHITE is inverted (white becomes the largest value), palettes give the 8-bit colours (the upper byte of the
  16-bit colour map, as libtiff does), the orientation tag is applied.
* Refused: complex, 64-bit integer and mixed-depth samples, CMYK, CIELab, raw mosaics, YCbCr outside JPEG, volumes;
  what is stated beyond what the file's bytes can hold.
"""

from __future__ import annotations

import functools
import logging
import math
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tifffile

from leafflow_ti.capture.channels import Array, Colour, ImageInfo, check_size
from leafflow_ti.capture.stored import StoredFile, one_line
from leafflow_ti.capture.tiff_segments import (
    MAX_SEGMENT_BYTES,
    PICTURES,
    PREDICTED,
    READ,
    Decode,
    Shapes,
    decoder,
    greatest_ratio,
    packed_row,
    segment_bytes,
    stored_limit,
)
from leafflow_ti.capture.tiff_structure import MAX_VALUES, check_structure
from leafflow_ti.errors import InputError, LeafflowError

_MINISWHITE, _MINISBLACK, _RGB, _PALETTE, _YCBCR = 0, 1, 2, 3, 6
_JPEG = 7
_PHOTOMETRIC, _STRIPS, _TILES = 262, 273, 324
_REFUSED_COLOURS = {4: "a mask", 5: "CMYK", 6: "YCbCr without JPEG", 8: "CIELab", 32803: "a raw colour mosaic"}
_ALPHA = (1, 2)  # associated, unassociated
_SEPARATE = 2
_FLOAT, _FLOAT_PREDICTORS = 3, (3, 34894, 34895)
STRIPS = 4
"""Compressed strips in an image from which on a window decodes those that it touches, not all of them."""

_reading = threading.local()


def _not_ours(_record: logging.LogRecord) -> bool:
    return not getattr(_reading, "depth", 0)


logging.getLogger("tifffile").addFilter(_not_ours)


@contextmanager
def quiet() -> Iterator[None]:
    """Drop what tifffile logs while this thread reads for us; what matters becomes an InputError."""
    _reading.depth = getattr(_reading, "depth", 0) + 1
    try:
        yield
    finally:
        _reading.depth -= 1


@dataclass(frozen=True, slots=True)
class TiffImage:
    """One decodable page: where its segments are, and how they become samples."""

    info: ImageInfo
    offsets: tuple[int, ...]
    counts: tuple[int, ...]
    decode: Decode | None  # None for a plain block, which needs no decoder
    palette: Array | None  # [3, 2**bits] uint8
    stored_shape: tuple[int, int]  # height, width before the orientation is applied
    stored_samples: int
    segment_shape: tuple[int, int]
    separate: bool  # one plane per sample
    contiguous: np.dtype[Any] | None  # the type in the file, byte order included, if the page is one plain block
    inverted: bool
    orientation: int


Pages = tuple[TiffImage | InputError, ...]


@functools.lru_cache(maxsize=4096)
def pages_of(stored: StoredFile) -> tuple[Pages, tuple[int, ...]]:
    """All pages (a page that cannot be read stands as its error), and the sizes of the stack's axes."""
    path, size = stored.path, stored.size
    try:
        with quiet(), stored.open() as file:
            headers = check_structure(stored, file)
            file.handle.seek(0)
            with tifffile.TiffFile(file.handle, name=path.name) as tif:
                if len(tif.pages) < headers:
                    raise InputError(f"{path}: page {len(tif.pages)} has a damaged header: write the file again")
                found = [page for page in tif.pages if isinstance(page, tifffile.TiffPage)]
                kept = [page for page in found if not page.subfiletype & 0b101] or found
                if not kept:
                    raise InputError(f"{path}: TIFF without an image: write the file again")
                pages = tuple(_page_or_error(path, page, size) for page in kept)
                count, shape = _stack(path, tif, kept)
    except LeafflowError:
        raise
    except Exception as error:
        raise InputError(f"{path}: damaged TIFF header ({one_line(error)}): write the file again") from error
    if count > len(pages):
        pages = _virtual_pages(path, pages[0], count, size)
    return pages, shape


def _stack(path: Path, tif: tifffile.TiffFile, kept: list[tifffile.TiffPage]) -> tuple[int, tuple[int, ...]]:
    """Number of pages and sizes of the stack's axes; ImageJ, tifffile and STK may store many behind one header."""
    n = len(kept)
    # Series of these kinds may pull in other files, or order pages by metadata: their own pages are all we take.
    if tif.is_ome or tif.is_mmstack or tif.is_lsm or tif.is_ndtiff:
        return n, (n,)
    if not (tif.is_shaped or tif.is_imagej or tif.is_stk) or len(tif.series) != 1:
        return n, (n,)
    if tif.is_imagej and n == 1:
        _check_imagej_length(path, tif, kept[0])
    series = tif.series[0]
    shape = tuple(
        size for size, axis in zip(series.shape, series.axes, strict=True) if axis not in "YXS" and size > 1
    ) or (1,)
    count = math.prod(shape)
    if n == 1 or count == n:
        return count, shape
    return n, (n,)


def _check_imagej_length(path: Path, tif: tifffile.TiffFile, page: tifffile.TiffPage) -> None:
    """One header for a stack: where the file ends before the last image, tifffile takes the first one for all."""
    said = tif.imagej_metadata or {}
    count = math.prod(max(1, int(said.get(name, 1))) for name in ("slices", "frames"))
    if page.dataoffsets and page.dataoffsets[0] + count * page.nbytes > tif.filehandle.size:
        raise InputError(f"{path}: header states {count} images, the file ends before: copy or write it again")


def _virtual_pages(path: Path, first: TiffImage | InputError, count: int, size: int) -> Pages:
    """Pages that follow the first one's data without headers of their own."""
    if isinstance(first, InputError):
        raise first
    if first.contiguous is None:
        raise InputError(f"{path}: {count} images behind one header, not stored plainly: save one header per image")
    step = first.contiguous.itemsize * first.stored_samples * first.stored_shape[0] * first.stored_shape[1]
    if first.offsets[0] + count * step > size:
        raise InputError(f"{path}: header states {count} images, the file ends before: copy or write it again")
    if count > MAX_VALUES:
        raise InputError(f"{path}: {count} images behind one header, more than {MAX_VALUES}: split the stack")
    return tuple(replace(first, offsets=(first.offsets[0] + k * step,), counts=(step,)) for k in range(count))


def _page_or_error(path: Path, page: tifffile.TiffPage, size: int) -> TiffImage | InputError:
    try:
        return _page(path, page, size)
    except InputError as error:
        return error
    except ValueError as error:
        return InputError(f"{path}: page {page.index}: {one_line(error)}: convert it to plain TIFF")


def _page(path: Path, page: tifffile.TiffPage, size: int) -> TiffImage:
    """Check one page and take from its header all that reading needs later, when the file is closed again."""
    name = f"{path}: page {page.index}"
    height, width, samples = page.imagelength, page.imagewidth, page.samplesperpixel
    check_size(path, height, width)
    if page.imagedepth != 1:
        raise InputError(f"{name}: a volume of depth {page.imagedepth} in one page: save one page per slice")
    if samples < 1:
        raise InputError(f"{name}: {samples} samples per pixel: damaged file, write it again")
    dtype = page.dtype
    if dtype is None or dtype.kind not in "buif" or (dtype.kind in "ui" and dtype.itemsize > 4):
        raise InputError(
            f"{name}: {page.bitspersample}-bit samples of format {page.sampleformat} are not supported: "
            "save as integer of at most 32 bit, or float"
        )
    if isinstance(page.bitspersample, tuple):
        raise InputError(f"{name}: samples of different depth {page.bitspersample}: save with one depth")
    dtype = np.dtype(np.uint8) if dtype.kind == "b" else dtype.newbyteorder("=")
    colour, visible = _colour(name, page)
    palette = _palette(name, page) if page.photometric == _PALETTE else None
    inverted = page.photometric == _MINISWHITE
    if inverted and dtype.kind != "u":
        raise InputError(f"{name}: white-is-zero with samples of type {dtype}: save as black-is-zero")
    orientation = int(page.tags.valueof(274, 1))
    if not 1 <= orientation <= 8:
        orientation = 1  # a value outside the standard: stored order, as readers do
    segment = (page.tilelength, page.tilewidth) if page.is_tiled else (min(page.rowsperstrip, height), width)
    if min(segment) < 1 or segment[0] * segment[1] > 2 * max(height * width, 2**24):
        raise InputError(f"{name}: strips or tiles of {segment[0]} x {segment[1]}: damaged file, write it again")
    if _STRIPS in page.tags and _TILES in page.tags:
        raise InputError(f"{name}: strips as well as tiles: which hold the image is not stated, write the file again")
    if page.compression not in READ:
        raise InputError(f"{name}: compression {int(page.compression)} is not read: save with LZW, Deflate or ZSTD")
    _check_predictor(name, page)
    separate = page.planarconfig == _SEPARATE and samples > 1
    plain = page.is_final
    shapes = functools.partial(_segment_shapes, (height, width), segment, page.is_tiled)
    result = TiffImage(
        info=ImageInfo(
            height=width if orientation > 4 else height,
            width=height if orientation > 4 else width,
            dtype=np.dtype(np.uint8) if palette is not None else dtype,
            bits=8 if palette is not None else int(page.bitspersample),
            samples=visible,
            colour=colour,
            windowed=(plain or page.is_tiled or STRIPS * segment[0] <= height) and orientation == 1,
        ),
        offsets=tuple(page.dataoffsets),
        counts=tuple(page.databytecounts),
        decode=None if plain else decoder(page, shapes, 1 if separate else samples),
        palette=palette,
        stored_shape=(height, width),
        stored_samples=samples,
        segment_shape=segment,
        separate=separate,
        contiguous=dtype.newbyteorder(page.parent.byteorder) if plain else None,
        inverted=inverted,
        orientation=orientation,
    )
    _check_segments(name, page, result, shapes, size)
    return result


def _colour(name: str, page: tifffile.TiffPage) -> tuple[Colour, int]:
    """Meaning and number of the samples that a reader of this page sees."""
    samples, kind = page.samplesperpixel, page.photometric
    if _PHOTOMETRIC not in page.tags:
        raise InputError(f"{name}: not stated whether black or white is zero (entry 262): write the file again")
    if kind == _PALETTE and samples == 1:
        return "rgb", 3
    if (kind == _RGB and samples >= 3) or (kind == _YCBCR and samples == 3 and page.compression == _JPEG):
        return "rgb", samples
    if kind in (_MINISWHITE, _MINISBLACK):
        alpha = len(page.extrasamples) == samples - 1 and all(extra in _ALPHA for extra in page.extrasamples)
        return ("gray" if alpha else "bands"), samples
    what = _REFUSED_COLOURS.get(int(kind), f"photometric {int(kind)}")
    raise InputError(f"{name}: {what} with {samples} samples is not supported: save as grey or RGB")


def _palette(name: str, page: tifffile.TiffPage) -> Array:
    table = page.colormap
    if table is None or table.shape != (3, 2**page.bitspersample):
        raise InputError(f"{name}: palette image without a complete colour map: save as grey or RGB")
    # Some writers store 8-bit values in the 16-bit table.
    return np.asarray(table if table.max() < 256 else table >> 8, np.uint8)


def _check_predictor(name: str, page: tifffile.TiffPage) -> None:
    """Readers disagree on predictors where the standard has none: some apply them, some do not."""
    predictor, compression = int(page.predictor), int(page.compression)
    applied = compression in PREDICTED and (predictor not in _FLOAT_PREDICTORS or page.sampleformat == _FLOAT)
    if predictor != 1 and compression not in PICTURES and not applied:
        raise InputError(
            f"{name}: predictor {predictor} for samples of format {int(page.sampleformat)} with compression "
            f"{compression} has no meaning: damaged, write it again"
        )


def _check_segments(name: str, page: tifffile.TiffPage, result: TiffImage, shapes: Shapes, size: int) -> None:
    """Every strip or tile must be listed, end inside the file, and be able to hold the samples that are stated."""
    rows, columns = segment_grid(result)
    needed = rows * columns * (result.stored_samples if result.separate else 1)
    lsm = page.parent.is_lsm  # its strips are not always those of one page; tifffile sorts them out
    listed = len(result.offsets) if lsm else page.tags[_TILES if page.is_tiled else _STRIPS].count
    if listed != needed or min(len(result.offsets), len(result.counts)) < needed:
        raise InputError(f"{name}: {listed} strips or tiles listed, {needed} needed: damaged, write it again")
    for offset, count in zip(result.offsets, result.counts, strict=False):
        if offset <= 0 or count <= 0:
            raise InputError(f"{name}: a strip or tile without data: sparse or truncated file, write it again")
        if offset + count > size:
            raise InputError(f"{name}: data end at byte {offset + count}, the file at {size}: truncated, copy it again")
    if result.contiguous is None:
        _check_plausible(name, page, result, shapes, size)
        return
    height, width = result.stored_shape
    row = width * result.stored_samples * result.contiguous.itemsize
    if (end := result.offsets[0] + height * row) > size:
        raise InputError(f"{name}: data end at byte {end}, the file at {size}: truncated, copy it again")
    if not 0 <= (stored := sum(result.counts)) - height * row < row and not lsm:
        raise InputError(f"{name}: {stored} bytes for {height} rows of {row}: damaged file, write it again")


def _check_plausible(name: str, page: tifffile.TiffPage, result: TiffImage, shapes: Shapes, size: int) -> None:
    """The bytes of every strip or tile must be able to hold its samples, all together those of the file."""
    samples, bits = 1 if result.separate else result.stored_samples, int(page.bitspersample)
    whole = segment_bytes(page)
    if whole > MAX_SEGMENT_BYTES:
        raise InputError(f"{name}: a strip or tile of {whole} bytes, more than {MAX_SEGMENT_BYTES}: save smaller ones")
    compression = int(page.compression)
    most = stored_limit(compression, whole, packed_row(result.segment_shape[1] * samples, bits))
    for index, count in enumerate(result.counts):
        height, width = min(shapes(index))
        least = height * packed_row(width * samples, bits) / greatest_ratio(compression)
        if not least <= count <= most:
            raise InputError(
                f"{name}: strip or tile {index} of {count} bytes for {height} x {width} pixels cannot be: "
                "damaged file, write it again"
            )
    if sum(result.counts) > 16 * size:
        raise InputError(f"{name}: strips or tiles overlap: damaged file, write it again")


def _segment_shapes(
    image: tuple[int, int], segment: tuple[int, int], tiled: bool, index: int
) -> tuple[tuple[int, int], tuple[int, int]]:
    """Rows and columns that a segment may have: as writers should store those at the lower and right edge, and not."""
    down, across = -(-image[0] // segment[0]), -(-image[1] // segment[1])
    row, column = divmod(index % (down * across), across)
    inside = min(segment[0], image[0] - row * segment[0]), min(segment[1], image[1] - column * segment[1])
    return (segment, inside) if tiled else (inside, segment)


def segment_grid(page: TiffImage) -> tuple[int, int]:
    """Number of strips or tiles down and across one plane."""
    (height, width), (rows, columns) = page.stored_shape, page.segment_shape
    return -(-height // rows), -(-width // columns)


def probe(stored: StoredFile) -> ImageInfo:
    """Header of the first page, number of pages, and whether the others are like it."""
    pages, shape = pages_of(stored)
    first = pages[0]
    if isinstance(first, InputError):
        raise first
    mismatch = ""
    for k, page in enumerate(pages):
        if isinstance(page, InputError):
            mismatch = f"page {k} cannot be read"
        elif _kind(page.info) != _kind(first.info):
            mismatch = f"page {k} is {_describe(page.info)}, page 0 is {_describe(first.info)}"
        if mismatch:
            break
    windowed = all(isinstance(page, TiffImage) and page.info.windowed for page in pages)
    return replace(first.info, pages=len(pages), page_shape=shape, mismatch=mismatch, windowed=windowed)


def _kind(info: ImageInfo) -> tuple[object, ...]:
    return info.height, info.width, info.dtype, info.bits, info.samples, info.colour


def _describe(info: ImageInfo) -> str:
    return f"{info.height} x {info.width} {info.colour} with {info.samples} samples of {info.bits} bit"


def page_at(stored: StoredFile, page: int) -> TiffImage:
    """One page, from 0; raises InputError if it does not exist or is of a kind that is not read."""
    pages, _ = pages_of(stored)
    if not 0 <= page < len(pages):
        raise InputError(f"{stored.path}: no page {page}, the file holds pages 0 to {len(pages) - 1}")
    found = pages[page]
    if isinstance(found, InputError):
        raise found
    return found
