"""Image files to start from: every format, layout and compression that is read, small; and bombs.

All bytes are made anew from fixed numbers; the TIFF example collection joins where it is present.
"""

from __future__ import annotations

import io
import struct
import zlib
from typing import Any

import imagecodecs
import numpy as np
import tifffile
from PIL import Image

from perf.inputs import data_folder

_LARGEST_EXAMPLE = 2**16
_BOMB = 2**25


def seeds(bomb: int = _BOMB) -> dict[str, bytes]:
    """All files by name; the ending tells the format. ``bomb``: pixels that the data of a bomb decode to."""
    rng = np.random.default_rng(1)
    y, x = np.mgrid[:37, :45]
    grey = (2 * y + 3 * x + rng.integers(0, 9, y.shape)).astype(np.uint8)
    found = {**_tiffs(grey), **_packed(grey), **_pngs(grey), **_pnms(grey), **_bombs(bomb)}
    examples = data_folder("tiff_examples")
    # Files of equal size are frames of one series.
    for path in {path.stat().st_size: path for path in sorted(examples.rglob("*.tif*"))}.values():
        if path.stat().st_size <= _LARGEST_EXAMPLE:
            found[f"example-{path.name}"] = path.read_bytes()
    return found


def _tiffs(grey: np.ndarray) -> dict[str, bytes]:
    deep = grey.astype(np.uint16) * 200
    real = (grey / np.float32(7)).astype(np.float32)
    rgb = np.stack([grey, 255 - grey, grey // 2], axis=-1)
    stack = np.stack([deep, deep + 1, deep + 2])
    options: dict[str, tuple[np.ndarray, dict[str, Any]]] = {
        "plain8": (grey, {}),
        "plain16be": (deep, {"byteorder": ">"}),
        "float": (real, {}),
        "double-tiled": (real.astype(np.float64), {"tile": (16, 16)}),
        "half": (real.astype(np.float16), {}),
        "strips": (deep, {"rowsperstrip": 5}),
        "tiles": (deep, {"tile": (16, 32)}),
        "big": (deep, {"bigtiff": True, "rowsperstrip": 9}),
        "rgb": (rgb, {"photometric": "rgb"}),
        "rgb-planes": (np.moveaxis(rgb, -1, 0), {"photometric": "rgb", "planarconfig": "separate"}),
        "white": (grey, {"photometric": "miniswhite"}),
        "stack": (stack, {"photometric": "minisblack"}),
        "imagej": (stack, {"imagej": True}),
        "ome": (stack, {"ome": True, "photometric": "minisblack"}),
        "turned": (grey, {"extratags": [(274, 3, 1, 6, True)], "metadata": None}),
    }
    schemes = ("zlib", "lzw", "packbits", "zstd", "lzma", "jpeg", "jpeg2000", "webp", "png")
    for name in schemes:
        image = rgb if name == "webp" else grey
        options[name] = image, {"compression": name, "rowsperstrip": 10}
        options[f"{name}-tiles"] = image, {"compression": name, "tile": (16, 16)}
    for name in ("zlib", "lzw", "zstd"):
        options[f"{name}-predicted"] = deep, {"compression": name, "predictor": True, "rowsperstrip": 8}
    options["float-predicted"] = real, {"compression": "zlib", "predictor": True}
    options["rgb-jpeg"] = rgb, {"compression": "jpeg", "photometric": "ycbcr", "subsampling": (2, 2)}
    result = {}
    for name, (image, more) in options.items():
        buffer = io.BytesIO()
        tifffile.imwrite(buffer, image, **more)
        result[f"{name}.tif"] = buffer.getvalue()
    pillow = {
        "palette": (Image.fromarray(grey).convert("P"), {}),
        "fax4": (Image.fromarray(grey > 128), {"compression": "group4"}),
        "fax3": (Image.fromarray(grey > 128), {"compression": "group3"}),
        "bilevel": (Image.fromarray(grey > 128), {}),
    }
    for name, (picture, more) in pillow.items():
        buffer = io.BytesIO()
        picture.save(buffer, "TIFF", **more)
        result[f"{name}.tif"] = buffer.getvalue()
    return result


def bare_tiff(segment: bytes, height: int, width: int, compression: int, bits: int = 8) -> bytes:
    """Little-endian TIFF of one strip, grey, without any library."""
    values = {256: width, 257: height, 258: bits, 259: compression, 262: 1, 273: 8, 277: 1, 278: height}
    values[279] = len(segment)
    entries = b"".join(struct.pack("<HHII", tag, 4, 1, values[tag]) for tag in sorted(values))
    header = struct.pack("<2sHI", b"II", 42, 8 + len(segment))
    return header + segment + struct.pack("<H", len(values)) + entries + bytes(4)


def _packed(grey: np.ndarray) -> dict[str, bytes]:
    result = {}
    for bits in (2, 4, 10, 12, 14):
        values = grey.astype(np.uint16) % 2**bits
        rows = (values[..., None] >> np.arange(bits - 1, -1, -1)) & 1
        data = np.packbits(rows.reshape(len(grey), -1).astype(np.uint8), axis=1).tobytes()
        result[f"packed{bits}.tif"] = bare_tiff(data, *grey.shape, 1, bits)
        result[f"packed{bits}-lzw.tif"] = bare_tiff(imagecodecs.lzw_encode(data), *grey.shape, 5, bits)
    return result


def png_chunk(kind: bytes, data: bytes) -> bytes:
    """One chunk with its length and check sum."""
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def _pngs(grey: np.ndarray) -> dict[str, bytes]:
    deep = grey.astype(np.uint16) * 200
    images = {"grey8": grey, "grey16": deep, "rgb8": np.dstack([grey] * 3), "rgba16": np.dstack([deep] * 4)}
    result = {f"{name}.png": imagecodecs.png_encode(image) for name, image in images.items()}
    for name, picture in {
        "palette": Image.fromarray(grey).convert("P"),
        "bilevel": Image.fromarray(grey > 128),
    }.items():
        buffer = io.BytesIO()
        picture.save(buffer, "PNG")
        result[f"{name}.png"] = buffer.getvalue()
    return result


def _pnms(grey: np.ndarray) -> dict[str, bytes]:
    size = f"{grey.shape[1]} {grey.shape[0]}".encode()
    deep, rgb = grey.astype(">u2") * 200, np.dstack([grey, 255 - grey, grey // 2])
    return {
        "a.pgm": b"P5\n# comment\n" + size + b"\n255\n" + grey.tobytes(),
        "deep.pgm": b"P5 " + size + b" 65535\n" + deep.tobytes(),
        "a.ppm": b"P6 " + size + b" 255\n" + rgb.tobytes(),
        "text.pgm": b"P2 " + size + b" 255\n" + b" ".join(b"%d" % v for v in grey.ravel()),
        "text.ppm": b"P3 " + size + b" 255\n" + b"\n".join(b"%d" % v for v in rgb.ravel()),
    }


def _bombs(pixels: int) -> dict[str, bytes]:
    """Images of 16 x 16 pixels whose data decode to ``pixels``, or 32 times as many where a scheme is that strong."""
    zeros = bytes(pixels)
    picture = np.zeros((pixels // 4096, 4096), np.uint8)
    segments = {
        8: zlib.compress(zeros, 9),
        5: imagecodecs.lzw_encode(zeros),
        32773: b"\x81\x00" * (pixels // 128),
        50000: imagecodecs.zstd_encode(zeros) * 32,
        34925: imagecodecs.lzma_encode(zeros),
        7: imagecodecs.jpeg_encode(picture),
        34712: imagecodecs.jpeg2k_encode(picture),
        34933: imagecodecs.png_encode(picture),
    }
    result = {f"bomb{number}.tif": bare_tiff(data, 16, 16, number) for number, data in segments.items()}
    header = png_chunk(b"IHDR", struct.pack(">IIBBBBB", 16, 16, 8, 0, 0, 0, 0))
    text = png_chunk(b"zTXt", b"Comment\0\0" + segments[8])
    profile = png_chunk(b"iCCP", b"name\0\0" + segments[8])
    pixels, end = png_chunk(b"IDAT", zlib.compress(bytes(17 * 16))), png_chunk(b"IEND", b"")
    magic = b"\x89PNG\r\n\x1a\n"
    result["bomb-text.png"] = magic + header + text * 20 + pixels + end
    result["bomb-profile.png"] = magic + header + profile + pixels + end
    result["bomb-data.png"] = magic + header + png_chunk(b"IDAT", segments[8]) + end
    return result
